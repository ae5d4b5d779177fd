"""The pictures of a saved map for make_pictures.py: 2D map, cuts with queries, mesh.

Each function takes the folder of a ``taichi-mrf map`` run and returns the picture. The mesh and the 2D map
are drawn from exported files, so the pictures show what other programs read.
"""

import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from PIL import Image

import taichi_mrf
from taichi_mrf.evaluation.pictures.figures import color_bar, draw_camera_path, new_figure
from taichi_mrf.evaluation.pictures.surfaces import seen_surfaces, up_direction, upward_axis
from taichi_mrf.evaluation.pictures.viewpoint import faces_viewer, overview_pose
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.queries.box import map_extent, slice_map
from taichi_mrf.queries.distance import DistanceField
from taichi_mrf.queries.frontiers import find_frontiers
from taichi_mrf.sensor.camera import PinholeCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAND_M = (-0.9, 0.3)
"""Heights of the 2D map, as in docs/queries.md: from above the floor to the height of a head."""

CUT_AT_M = -0.4
CLEARANCE_M = 1.0

_CAMERA = PinholeCamera(width=1400, height=900, fx=1500.0, fy=1500.0, cx=699.5, cy=449.5)
_AMBIENT = 0.35
_FRONTIER_COLOR = "#e6007e"
_DPI = 100


def level_map(run: Path) -> Image.Image:
    """The exported .pgm at the position in its .yaml file, with the path of the camera."""
    m = taichi_mrf.load_map(run / "map.npz")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "floor.pgm"
        export_map(m, path, ExportOptions(z_min=BAND_M[0], z_max=BAND_M[1]))
        grey = np.asarray(Image.open(path))
        origin_x, origin_y, _ = yaml.safe_load(path.with_suffix(".yaml").read_text())["origin"]
    rows, columns = grey.shape
    extent = (origin_x, origin_x + columns * m.voxel_size, origin_y, origin_y + rows * m.voxel_size)
    figure = new_figure(8.0, 6.2)
    axes = figure.add_subplot()
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="nearest")
    draw_camera_path(axes, _camera_path(m)[:, :2])
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(f"z from {BAND_M[0]} to {BAND_M[1]} m: occupied (black), free (white), unknown (grey)")
    return _drawn(figure)


def cuts(run: Path) -> Image.Image:
    """A level cut of the marginals with the frontiers in that layer, and the distance to what is occupied."""
    m = taichi_mrf.load_map(run / "map.npz")
    cut = slice_map(m, at=CUT_AT_M)
    lower_m, upper_m = map_extent(m)
    lower_m[2], upper_m[2] = cut.at_m - m.voxel_size, cut.at_m + m.voxel_size
    field = DistanceField(m, CLEARANCE_M, lower=lower_m, upper=upper_m)
    rows, columns = cut.occupancy.shape
    left, _, bottom, _ = cut.extent
    x = left + (np.arange(columns) + 0.5) * m.voxel_size
    y = bottom + (np.arange(rows) + 0.5) * m.voxel_size
    places = np.stack([*np.meshgrid(x, y), np.full((rows, columns), cut.at_m)], axis=-1)
    distance = field.distance(places.reshape(-1, 3)).reshape(rows, columns)
    known = cut.state != taichi_mrf.UNKNOWN
    frontier = find_frontiers(m).points
    frontier = frontier[np.abs(frontier[:, 2] - cut.at_m) < 0.5 * m.voxel_size]

    figure = new_figure(13.0, 5.0)
    first, second = figure.subplots(1, 2)
    first.set_title(f"slice_map at {cut.axis} = {cut.at_m:.2f} m, find_frontiers (magenta)")
    second.set_title("DistanceField in the same layer")
    for axes, values, colors, most, label in (
        (first, cut.occupancy, "viridis", 1.0, "marginal occupancy"),
        (second, distance, "magma", CLEARANCE_M, "metres to what is occupied"),
    ):
        values = np.where(known, values, np.nan)
        shown = axes.imshow(values, cmap=colors, vmin=0, vmax=most, origin="lower", extent=cut.extent)
        axes.set(xlabel="x (m)", ylabel="y (m)", facecolor="0.85")
        figure.colorbar(shown, ax=axes, label=label + "; grey: unknown", shrink=0.9)
    first.plot(*frontier[:, :2].T, ".", color=_FRONTIER_COLOR, markersize=3)
    return _drawn(figure)


def mesh(run: Path) -> Image.Image:
    """The mesh of ``--mesh`` from the viewpoint of the overview, without triangles that hide the inside."""
    import trimesh
    from matplotlib.colors import ListedColormap

    from taichi_mrf.voxels.colors import LOWEST, viridis

    m = taichi_mrf.load_map(run / "map.npz")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.ply"
        export_map(m, path, ExportOptions(mesh=True))
        solid = trimesh.load_mesh(path, process=False)
    count = len(solid.faces)
    surfaces = seen_surfaces(m)
    up = up_direction(map(upward_axis, m.keyframes.values()), surfaces.normals)
    normals = surfaces.thickened().normals_at(solid.triangles_center)
    pose = overview_pose(solid.triangles_center, normals, up, _CAMERA, m.voxel_size)
    solid.update_faces(faces_viewer(solid.triangles_center, normals, pose[:3, 3]))

    rays = _CAMERA.rays().reshape(-1, 3) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hit = solid.ray.intersects_first(np.broadcast_to(pose[:3, 3], rays.shape), rays)
    light = pose[:3, :3] @ [-0.45, -0.6, -0.66]
    brightness = _AMBIENT + (1 - _AMBIENT) * np.abs(solid.face_normals @ light)
    colors = solid.visual.face_colors[:, :3] * brightness[:, None]
    picture = np.where((hit >= 0)[:, None], colors[hit], 255).astype(np.uint8).reshape(*_CAMERA.shape, 3)

    figure = new_figure(11.7, 7.2)
    axes = figure.add_subplot()
    axes.imshow(picture, interpolation="antialiased")
    axes.set_title(f"marching cubes, {count:,} triangles; those that face away left out")
    axes.axis("off")
    color_bar(axes, ListedColormap(viridis() / 255.0), LOWEST, 1.0, "marginal occupancy")
    return _drawn(figure)


def _camera_path(m: taichi_mrf.MRFMap) -> np.ndarray:
    """The positions of the keyframes' cameras, (K, 3) metres."""
    return np.array([each.T_world_camera[:3, 3] for each in m.keyframes.values()])


def _drawn(figure: "Figure") -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return Image.open(buffer).convert("RGB")
