"""Meshes and cubes, read back by trimesh: a ball whose surface is known, and the room."""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hand_made import VOXEL
from queried_maps import HandMap, hand_map, map_of, room_map

from taichi_mrf.errors import ConfigError, TaichiMRFError
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.export.surface import smooth_surface, voxel_surface
from taichi_mrf.geometry.up import y_up
from taichi_mrf.voxels.colors import marginal_colors

pytestmark = pytest.mark.usefixtures("one_backend")

RADIUS = 0.46


@pytest.fixture(scope="module")
def ball(one_backend: str) -> HandMap:
    """Around (0, 0, 0), where eight chunks meet; the marginal is one half at the radius."""
    centres = (np.indices((32, 32, 32)) - 16 + 0.5) * VOXEL
    return map_of(one_backend, (-16, -16, -16), 40 * (RADIUS - np.linalg.norm(centres, axis=0)))


def loaded(path: Path) -> trimesh.Trimesh:
    scene = trimesh.load(path, process=False)
    return scene.to_geometry() if isinstance(scene, trimesh.Scene) else scene


def likeliest_beside(m: HandMap, points: np.ndarray) -> np.ndarray:
    """The largest marginal of the voxels whose centres a point lies between, by point queries."""
    centres = points / m.voxel_size - 0.5
    ends = np.floor(centres + 1e-4), np.ceil(centres - 1e-4)
    corners = [np.where(np.array(corner), ends[1], ends[0]) for corner in np.ndindex(2, 2, 2)]
    return np.max([m.occupancy((corner + 0.5) * m.voxel_size) for corner in corners], axis=0)


def test_marching_cubes_find_the_ball(ball: HandMap) -> None:
    surface = smooth_surface(ball, 0.5)
    radius = np.linalg.norm(surface.vertices_m, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.1 * VOXEL
    mesh = trimesh.Trimesh(surface.vertices_m, surface.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    outwards = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
    assert (outwards > 0).all()


def test_another_level_is_another_surface(ball: HandMap) -> None:
    level = 1 / (1 + np.exp(-40 * 0.02))
    radius = np.linalg.norm(smooth_surface(ball, level).vertices_m, axis=1)
    assert np.abs(radius - (RADIUS - 0.02)).max() < 0.15 * VOXEL


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj", "stl"])
def test_meshes_come_back(ball: HandMap, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"ball.{suffix}"
    assert export_map(ball, path, ExportOptions(mesh=True)) == [path]
    found, wanted = loaded(path), smooth_surface(ball, 0.5)
    vertices = wanted.vertices_m
    if suffix == "glb":  # y is up there
        vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]
    assert len(found.faces) == len(wanted.triangles)
    np.testing.assert_allclose(found.triangles, vertices[wanted.triangles], atol=1e-5)
    assert found.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    if suffix != "stl":
        np.testing.assert_allclose(found.visual.vertex_colors[:, :3], wanted.colors, atol=1)


def test_a_glb_stands_upright_whatever_is_up_in_the_world(ball: HandMap, tmp_path: Path) -> None:
    """As in a map whose world is its first camera: y points down."""
    keyframe = SimpleNamespace(T_world_camera=np.eye(4))
    export_map(dataclasses.replace(ball, keyframes={0: keyframe}), tmp_path / "ball.glb")
    wanted = smooth_surface(ball, 0.5)
    vertices = wanted.vertices_m * [1, -1, -1]
    np.testing.assert_allclose(loaded(tmp_path / "ball.glb").triangles, vertices[wanted.triangles], atol=1e-5)
    for up in ((axis, sign) for axis in range(3) for sign in (1, -1)):
        T = y_up(up)
        np.testing.assert_array_equal(T[:3, :3] @ np.eye(3)[up[0]] * up[1], [0, 1, 0])
        assert np.linalg.det(T) == pytest.approx(1.0)


def test_cubes_are_the_outsides_of_the_voxels(backend: str, tmp_path: Path) -> None:
    m = hand_map(backend)
    export_map(m, tmp_path / "cubes.ply", ExportOptions(cubes=True))
    found = trimesh.load(tmp_path / "cubes.ply", process=False)
    centres, p = m.voxels(0.5)
    occupied = {tuple(v) for v in np.floor(centres / VOXEL).astype(int).tolist()}
    steps = [tuple(s) for s in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]).tolist()]
    sides = sum(tuple(np.add(v, s).tolist()) not in occupied for v in occupied for s in steps)
    assert len(found.faces) == 2 * sides > 5000
    assert found.volume == pytest.approx(len(occupied) * VOXEL**3, rel=1e-4)
    assert found.area == pytest.approx(sides * VOXEL**2, rel=1e-4)
    # Each triangle lies on its voxel's side, half a voxel outwards from the centre, in the voxel's colour.
    inner = found.triangles_center - 0.5 * VOXEL * found.face_normals
    voxel = np.floor(inner / VOXEL).astype(int)
    assert {tuple(v) for v in voxel.tolist()} <= occupied
    color_of = dict(
        zip(map(tuple, np.floor(centres / VOXEL).astype(int).tolist()), marginal_colors(p), strict=True)
    )
    colors = found.visual.vertex_colors[found.faces[:, 0], :3]
    np.testing.assert_array_equal(colors, [color_of[tuple(v)] for v in voxel.tolist()])


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_the_rooms_surface(method: str) -> None:
    """Chunks fit together without a seam, and what is unknown is no surface where nothing is occupied."""
    m = room_map(method)
    surface = smooth_surface(m, 0.5)
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count % 2 == 0).all()
    assert len(surface.triangles) > 5000
    assert (likeliest_beside(m, surface.vertices_m) > 0.5).all()


def test_colours_are_those_of_the_likeliest_voxel_beside(ball: HandMap) -> None:
    surface = smooth_surface(ball, 0.5)
    wanted = marginal_colors(likeliest_beside(ball, surface.vertices_m))
    np.testing.assert_array_equal(surface.colors, wanted)
    assert len(np.unique(wanted, axis=0)) > 5


def test_no_surface_is_said_and_not_written(ball: HandMap, backend: str, tmp_path: Path) -> None:
    empty = map_of(backend, (0, 0, 0), np.full((8, 8, 8), -5.0))
    for options in (ExportOptions(), ExportOptions(cubes=True)):
        with pytest.raises(ConfigError, match=r"m\.glb: no voxel has a probability of 0\.5"):
            export_map(empty, tmp_path / "m.glb", options)
    assert not list(tmp_path.iterdir())
    assert len(voxel_surface(empty, 0.5).triangles) == 0


def test_without_the_libraries(ball: HandMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(TaichiMRFError, match=r"\.obj files need trimesh.*pip install 'taichi-mrf\[mesh\]'"):
        export_map(ball, tmp_path / "m.obj", ExportOptions(cubes=True))
    export_map(ball, tmp_path / "cubes.ply", ExportOptions(cubes=True))
    assert [path.name for path in tmp_path.iterdir()] == ["cubes.ply"]
