"""Surfaces as files: PLY by our own writer; glTF (.glb), OBJ and STL by trimesh, of the extra ``mesh``."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.export.ply import NO_ORIGIN, write_surface
from taichi_mrf.export.surface import Surface
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system.atomic import atomic_path
from taichi_mrf.system.libraries import library


def write_mesh(
    path: str | Path,
    surface: Surface,
    voxel_size: float,
    T_gltf_world: Pose | None = None,
    origin_m: tuple[float, float, float] = NO_ORIGIN,
) -> None:
    """Write a surface in the format of the file's extension: .ply, .glb, .obj or .stl, which has no colours.

    ``T_gltf_world`` is where the world stands in a .glb, in which y is up; the vertices stay in the world,
    and the file's only node holds it. A .ply and an .obj have coordinates of the recorded world, in which the
    map's origin is ``origin_m``; the numbers of the others are too short for a far one. Raises MapFileError,
    and TaichiMRFError without trimesh for all but .ply.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ply":
        comments = [f"voxel_size {voxel_size:.9g} metres", surface.colors_note]
        extra: dict[str, NDArray] = {}
        if surface.normals is not None:
            extra |= dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
        if surface.std_m is not None:
            extra["std_m"] = surface.std_m
        write_surface(path, surface.vertices_m, surface.triangles, surface.colors, extra, comments, origin_m)
        return
    trimesh = library("trimesh", f"{suffix} files need", "mesh")
    far = suffix == ".obj" and any(origin_m)
    vertices_m = surface.vertices_m.astype(np.float64) + origin_m if far else surface.vertices_m
    mesh = trimesh.Trimesh(
        vertices_m, surface.triangles, vertex_normals=surface.normals,
        vertex_colors=surface.colors, process=False, validate=False,
    )  # fmt: skip
    whole = mesh
    if suffix == ".glb":
        whole = trimesh.Scene()
        transform = np.eye(4) if T_gltf_world is None else T_gltf_world
        whole.add_geometry(mesh, node_name="map", geom_name="map", transform=transform)
    content = whole.export(file_type=suffix[1:])
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode("ascii") if isinstance(content, str) else content)
