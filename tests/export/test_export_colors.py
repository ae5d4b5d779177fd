"""Files in the colours that cameras saw, read back by other programs."""

from pathlib import Path
from types import SimpleNamespace

import colored_scene as scene
import numpy as np
import pytest
import trimesh
from queried_maps import map_of, room_map

from taichi_mrf.errors import ConfigError
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.octomap import BRICK_LEVEL, DEPTH, WHITE, channels, octree_of
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.colored import blended_colors
from taichi_mrf.voxels.colors import NO_COLOR, marginal_colors

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture(scope="module")
def m(backend: str) -> MRFMap:
    return scene.build([0, 1, 2, 3])


def shown(m: MRFMap, points: np.ndarray) -> np.ndarray:
    """A voxel's colour, else the mean of the smallest cell around it that has one, else grey."""
    found = np.full((len(points), 3), float(NO_COLOR))
    for side in (8, 4, 2, 1):
        first = np.floor(points / scene.VOXEL / side) * side
        sums, weights = np.zeros((len(points), 3)), np.zeros((len(points), 1))
        for step in np.ndindex(side, side, side):
            color = m.colors((first + step + 0.5) * scene.VOXEL).astype(float)
            sums, weights = sums + color[:, :3] * color[:, 3:], weights + color[:, 3:]
        has = weights[:, 0] > 0
        found[has] = sums[has] / weights[has]
    return found


def vertex_colors(path: Path) -> tuple[np.ndarray, np.ndarray]:
    found = trimesh.load(path, process=False)
    mesh = found.to_geometry() if isinstance(found, trimesh.Scene) else found
    return mesh.vertices, mesh.visual.vertex_colors[:, :3].astype(int)


def test_points_and_cubes_have_the_colours_of_their_voxels(m: MRFMap, tmp_path: Path) -> None:
    export_map(m, tmp_path / "points.ply", ExportOptions(cells=False))
    cloud = trimesh.load(tmp_path / "points.ply")
    centres, p = m.decided.voxels(0.5)
    np.testing.assert_allclose(cloud.colors[:, :3], shown(m, centres), atol=0.51)
    assert b"color is what cameras saw" in (tmp_path / "points.ply").read_bytes()[:400]
    export_map(m, tmp_path / "marginals.ply", ExportOptions(color_by="marginal", cells=False))
    cloud = trimesh.load(tmp_path / "marginals.ply")
    np.testing.assert_array_equal(cloud.colors[:, :3], marginal_colors(p))
    export_map(m, tmp_path / "cubes.ply", ExportOptions(cubes=True))
    cubes = trimesh.load(tmp_path / "cubes.ply", process=False)
    inner = cubes.triangles_center - 0.5 * scene.VOXEL * cubes.face_normals
    found = cubes.visual.vertex_colors[cubes.faces[:, 0], :3]
    np.testing.assert_allclose(found, shown(m, inner), atol=0.51)


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_meshes_are_red_in_front_and_blue_behind(m: MRFMap, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh.{suffix}"
    export_map(m, path, ExportOptions(mesh=True, up="z"))
    vertices, colors = vertex_colors(path)
    depth = vertices[:, 1] if suffix == "glb" else vertices[:, 2]  # y is up in a .glb
    seen = (colors != NO_COLOR).any(axis=1)
    assert seen.mean() > 0.9
    for rows, own in ((depth < 1.6, scene.RED), (depth > 1.6, scene.BLUE)):
        off = np.abs(colors[rows & seen] - own.astype(int)).max(axis=1)
        assert len(off) > 100
        assert np.median(off) <= 1
        assert (off > 60).mean() < 0.05


def test_colours_between_voxels_are_blended(m: MRFMap) -> None:
    points, _ = m.voxels(0.5)
    points = points[m.colors(points)[:, 3] > 0]
    np.testing.assert_array_equal(blended_colors(m, points), m.colors(points)[:, :3])  # in their centres
    between = points + 0.5 * scene.VOXEL * np.array([1.0, 0.0, 0.0])
    a, b = m.colors(points).astype(float), m.colors(points + np.array([scene.VOXEL, 0, 0])).astype(float)
    both = (a[:, 3] > 0) & (b[:, 3] > 0)
    weights = a[both, 3:] + b[both, 3:]
    mean = (a[both, :3] * a[both, 3:] + b[both, :3] * b[both, 3:]) / weights
    np.testing.assert_allclose(blended_colors(m, between[both]), mean, atol=1)


def test_octomap_reads_the_colours(m: MRFMap, tmp_path: Path) -> None:
    octomap = pytest.importorskip("pyoctomap", reason="OctoMap itself is not here: pip install pyoctomap")
    export_map(m, tmp_path / "map.ot")
    tree = octomap.ColorOcTree(scene.VOXEL)
    tree = tree.read(str(tmp_path / "map.ot")) or tree
    assert type(tree).__name__ == "ColorOcTree"
    centres, _ = m.voxels(0.5)
    color = m.colors(centres)
    wanted = np.where(color[:, 3:] > 0, color[:, :3], 255)
    for point, rgb in zip(centres[::7], wanted[::7], strict=True):
        node = tree.search(point)
        assert tuple(node.getColor()) == tuple(rgb.tolist())
    assert tree.write(str(tmp_path / "again.ot"))
    data = [(tmp_path / n).read_bytes().partition(b"\ndata\n")[2] for n in ("map.ot", "again.ot")]
    assert data[0] == data[1]
    export_map(m, tmp_path / "plain.ot", ExportOptions(color_by="marginal"))
    assert b"id OcTree\n" in (tmp_path / "plain.ot").read_bytes()[:200]


def test_leaves_of_other_colours_are_not_joined_and_inner_nodes_have_the_mean(backend: str) -> None:
    """A solid brick, red up to x = 4 and blue beyond, but for one voxel without a colour."""
    solid = map_of(backend, (0, 0, 0), np.full((8, 8, 8), 3.0))
    colors = np.zeros((1, 512, 4), np.uint8)
    colors[0, :256], colors[0, 256:] = (*scene.RED, 9), (*scene.BLUE, 9)
    colors[0, 0] = 0
    painted = SimpleNamespace(colors_in=lambda slots: colors)
    assert len(octree_of(solid, only_state=True)) == 1 + DEPTH - BRICK_LEVEL
    nodes = octree_of(solid, only_state=True, colored=painted)
    leaves = nodes.children == 0
    np.testing.assert_array_equal(np.bincount(nodes.level[leaves]), [8, 7, 7])
    top = channels(nodes.color[nodes.level == BRICK_LEVEL])[0].astype(int)
    np.testing.assert_array_equal(top, (scene.RED.astype(int) + scene.BLUE) // 2)
    assert (nodes.color[leaves] == WHITE).sum() == 1


def test_a_page_shows_photos_and_a_map_without_colours_has_none(m: MRFMap, tmp_path: Path) -> None:
    export_map(m, tmp_path / "photo.html")
    export_map(m, tmp_path / "marginal.html", ExportOptions(color_by="marginal"))
    assert (tmp_path / "photo.html").read_bytes() != (tmp_path / "marginal.html").read_bytes()
    with pytest.raises(ConfigError, match="the map has no colours"):
        export_map(room_map("mrf"), tmp_path / "room.ply", ExportOptions(color_by="photo"))
