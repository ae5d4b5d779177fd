"""The surface of a field of signed distances: where it lies, which way it faces, and how sure it is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf import MRFMap, PinholeCamera, PolynomialNoise
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.fused_surface import _normals, without_free
from taichi_mrf.export.options import ExportOptions

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(80, 60, 80.0, 80.0, 39.5, 29.5)
VOXEL, SIGMA, BIAS = 0.05, 0.02, 0.04
NORMAL = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])


def _depth_of_plane(T_world_camera: np.ndarray, distance_m: float) -> np.ndarray:
    """Clean axial depth of the plane NORMAL . x = -distance_m."""
    origin, directions = T_world_camera[:3, 3], CAMERA.rays() @ T_world_camera[:3, :3].T
    return (-distance_m - origin @ NORMAL) / (directions @ NORMAL)


def _map_of_plane(noise_m: float) -> MRFMap:
    rng = np.random.default_rng(1)
    m = MRFMap(VOXEL, PolynomialNoise((SIGMA,), (BIAS,)))
    for x in (-0.3, 0.0, 0.3):
        T = np.eye(4)
        T[0, 3] = x
        depth = _depth_of_plane(T, 1.5) + BIAS + rng.normal(0, noise_m, CAMERA.shape)
        m.add_keyframe(depth.astype(np.float32), T, CAMERA)
    m.infer()
    return m


def test_a_plane_lies_where_it_is() -> None:
    surface = _map_of_plane(0.0).surface()
    error = surface.vertices_m @ NORMAL + 1.5
    assert len(surface.triangles) > 500
    assert np.abs(error).mean() < 0.05 * VOXEL  # neither its slope nor the bias moves it
    inner = np.abs(surface.vertices_m[:, :2]).max(axis=1) < 0.4  # not where images end
    assert np.abs(error[inner]).max() < 0.2 * VOXEL
    assert (surface.normals[inner] @ NORMAL).mean() > 0.99
    corners = surface.vertices_m[surface.triangles]
    wound = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ NORMAL
    assert (wound > 0).mean() > 0.99


def test_depth_of_a_wall_on_voxels_faces_is_rendered_where_it_is() -> None:
    pytest.importorskip("embreex")
    m = MRFMap(VOXEL, PolynomialNoise((SIGMA,), (0.0,)))
    for x in (-0.3, 0.0, 0.3):
        T = np.eye(4)
        T[0, 3] = x
        m.add_keyframe(np.full(CAMERA.shape, 30 * VOXEL, np.float32), T, CAMERA)
    m.infer()
    T[:3, 3] = 0.1, 0.05, 0.2
    depth_m = m.surface().render_depth(CAMERA, T)
    inner = (slice(15, 45), slice(20, 60))
    np.testing.assert_allclose(depth_m[inner], 30 * VOXEL - 0.2, atol=0.04 * VOXEL)
    # The middle of a voxel, in front of the wall or behind it, is half a voxel away.
    assert np.abs(m.render_depth(CAMERA, T, by="omega")[inner] - (30 * VOXEL - 0.2)).mean() > 0.4 * VOXEL
    np.testing.assert_allclose(m.render_depth(CAMERA, T)[inner], depth_m[inner], atol=0.01 * VOXEL)
    T_far = T.copy()
    T_far[2, 3] -= 1.0  # past the edge of the surface
    far = m.render_depth(CAMERA, T_far, by="omega")
    holes = np.isnan(m.measured_depth(far, CAMERA, T_far))
    assert holes.any()
    np.testing.assert_array_equal(m.render_depth(CAMERA, T_far)[holes], far[holes])
    T[:3, :3] = np.diag([-1.0, 1.0, -1.0])  # the other way, where nothing is
    assert np.isnan(m.surface().render_depth(CAMERA, T)).all()
    assert np.isnan(m.render_depth(CAMERA, T)).all()


def test_the_standard_deviation_grows_where_rays_are_few() -> None:
    surface = _map_of_plane(SIGMA).surface()
    error = np.abs(surface.vertices_m @ NORMAL + 1.5)
    assert np.mean(error <= 2 * surface.std_m) > 0.9
    middle = np.abs(surface.vertices_m[:, :2]).max(axis=1) < 0.3
    assert surface.std_m[middle].mean() < 0.5 * surface.std_m.max()


def test_normals_differ_around_a_fold_and_nowhere_else() -> None:
    rows, columns = 4, 12  # a strip of squares, folded at a right angle in its middle
    along, across = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    folded = np.maximum(along - columns // 2, 0)
    vertices = np.stack([along - folded, across, folded], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, up = corner + 1, corner + columns + 1
    triangles = np.concatenate(
        [np.stack(each, axis=1) for each in ((corner, right, up), (right, up + 1, up))]
    )
    normals, bent = _normals(vertices, triangles)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    far = np.abs(along.ravel() - columns // 2)
    np.testing.assert_allclose(bent[far >= 4], 0, atol=1e-12)
    assert bent[far == 0].min() > bent[far == 2].max() > 1e-3


def test_files_hold_it_by_default(tmp_path: Path) -> None:
    m = _map_of_plane(SIGMA)
    surface = m.surface()
    trimesh = pytest.importorskip("trimesh")
    for name in ("plane.ply", "plane.glb", "plane.obj", "plane.stl"):
        export_map(m, tmp_path / name, ExportOptions(mesh=True, up="z"))
        assert "3 keyframes" in str(export_note(m, tmp_path / name, ExportOptions(mesh=True)))
        loaded = trimesh.load_mesh(tmp_path / name, process=False)
        assert len(loaded.faces) == len(surface.triangles)
    header = (tmp_path / "plane.ply").read_bytes()[:1000]
    assert b"property float std_m" in header
    assert b"property float nx" in header


def test_frozen_keyframes_leave_the_marginals(tmp_path: Path) -> None:
    m = _map_of_plane(0.0)
    m.freeze_keyframe(0)
    with pytest.raises(ConfigError, match="again with --keep-surface"):
        export_map(m, tmp_path / "plane.ply", ExportOptions(mesh=True, surface="rays"))
    export_map(m, tmp_path / "plane.ply", ExportOptions(mesh=True))
    assert b"std_m" not in (tmp_path / "plane.ply").read_bytes()[:1000]


def test_a_map_without_keyframes_has_no_surface() -> None:
    with pytest.raises(ConfigError, match="no keyframes"):
        MRFMap(VOXEL).surface()


def test_no_surface_where_the_marginals_say_free() -> None:
    m = _map_of_plane(0.0)
    found = m.surface()
    stray = dataclasses.replace(found, vertices_m=found.vertices_m - [0, 0, 0.9])
    left = without_free(stray, VOXEL, m.occupancy, 0.05)
    assert np.abs(left.vertices_m[:, :2]).max(axis=1).min() > 0.1  # beside the images all is unknown
    assert np.abs(stray.vertices_m[:, :2]).max(axis=1).min() < 0.1
    assert len(without_free(found, VOXEL, m.occupancy, 0.05).triangles) == len(found.triangles)
