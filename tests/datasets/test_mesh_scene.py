"""Meshes as scenes: what is rendered is where the triangles are, and what is wrong with a file is said."""

import sys
from pathlib import Path

import numpy as np
import pytest
from console import taichi_mrf
from datasets_recordings import write_rows
from numpy.typing import NDArray
from refusals import bad_frame, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic import mesh_scene
from taichi_mrf.datasets.synthetic.analytic_scene import KINDS, Scene, Solid, distance_to
from taichi_mrf.datasets.synthetic.mesh_scene import (
    MeshScene,
    MeshSequence,
    TriangleMesh,
    load_mesh,
    scene_mesh,
)
from taichi_mrf.datasets.synthetic.room_furniture import camera_pose, room_scene
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.simulate import KINECT_1, KINECT_1_LATERAL, simulate

trimesh = pytest.importorskip("trimesh", reason="meshes need the extra 'mesh': trimesh is not installed")
pytest.importorskip("embreex", reason="meshes need the extra 'mesh': embreex is not installed")

CAMERA = PinholeCamera(width=160, height=120, fx=131.25, fy=131.25, cx=79.5, cy=59.5)
ROOM = (9.6, 8.0, 3.0)
PLY_OF_ONE_TRIANGLE = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
POSES = [look_at((0.3, -0.2, 0.1), (4.0, 3.0, -1.0)), look_at((-2.0, 1.0, 0.5), (3.0, -3.9, 0.0))]


def box_mesh(extents: tuple[float, float, float] = ROOM) -> TriangleMesh:
    box = trimesh.creation.box(extents)
    return TriangleMesh(np.array(box.vertices), np.array(box.faces, np.int32))


def depth_in_box(camera: PinholeCamera, T: NDArray[np.float64], extents: tuple[float, ...]) -> NDArray:
    """Axial depth of the walls of a box around the origin, seen from inside, (H, W)."""
    directions = camera.rays() @ T[:3, :3].T
    walls = np.sign(directions) * np.array(extents) / 2
    with np.errstate(divide="ignore"):
        return ((walls - T[:3, 3]) / directions).min(axis=-1)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A room as a PLY file and two poses in it."""
    mesh = tmp_path / "room.ply"
    trimesh.creation.box(ROOM).export(mesh)
    return mesh, write_rows(tmp_path / "poses.txt", POSES)


@pytest.mark.parametrize("T", POSES)
@pytest.mark.parametrize("offset", [(0, 0, 0), (5000.0, -3000.0, 100.0)])
def test_depth_in_a_box_is_the_formulas(T: NDArray[np.float64], offset: tuple[float, ...]) -> None:
    mesh = box_mesh()
    moved = T.copy()
    moved[:3, 3] += offset
    rendered = MeshScene(TriangleMesh(mesh.vertices + offset, mesh.triangles)).render_depth(CAMERA, moved)
    assert rendered.dtype == np.float32
    expected = depth_in_box(CAMERA, T, ROOM)
    assert expected.max() > 5
    assert np.abs(rendered - expected).max() < 1e-5


def test_a_ray_that_meets_nothing_has_no_depth() -> None:
    scene = MeshScene(box_mesh((1.0, 1.0, 1.0)))
    depth = scene.render_depth(CAMERA, look_at((-3, 0, 0), (0, 0, 0)))
    x = np.abs(CAMERA.rays()[..., :2]).max(axis=-1) * 2.5  # at the depth of the near face
    np.testing.assert_allclose(depth[x < 0.499], 2.5, atol=1e-6)
    assert (depth[x > 0.501] == 0).all()
    assert (scene.render_depth(CAMERA, look_at((3, 0, 0), (9, 0, 0))) == 0).all()
    nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert (MeshScene(nothing).render_depth(CAMERA, np.eye(4)) == 0).all()


def test_rays_that_start_off_the_camera_meet_a_triangle_where_a_closed_form_says() -> None:
    # A triangle through three points of the camera's frame, on a plane n x = 1.
    corners = np.array([[-3.0, -3.0, 1.5], [4.0, -3.0, 2.0], [-1.0, 4.0, 2.5]])
    normal = np.linalg.solve(corners, np.ones(3))
    T, start = POSES[0], np.array([0.2, -0.1, 0.05])
    mesh = TriangleMesh(corners @ T[:3, :3].T + T[:3, 3], np.array([[0, 1, 2]], np.int32))
    directions = CAMERA.rays()
    moving = RayTable(directions, np.tile(start, (CAMERA.width, 1)))
    found = MeshScene(mesh).render_depth(moving, T)
    expected = (1.0 - start @ normal) / (directions @ normal)
    # A point is inside where its shares of the corners are positive.
    shares = (start + directions * expected[..., None]) @ np.linalg.inv(corners)
    inside = (shares > 1e-3).all(axis=-1)
    assert 0.1 < inside.mean() <= 1
    np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-5)
    outside = (shares < -1e-3).any(axis=-1)
    assert (found[outside] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_an_analytic_solids_triangles_lie_on_it_and_close_around_it(kind: str) -> None:
    solid = Solid(kind, (0.3, -0.2, 0.5), (0.3, 0.2, 0.4), yaw=0.7)  # type: ignore[arg-type]
    mesh = scene_mesh(Scene((solid,), light=(0, 0, 3)), sag_m=1e-4)
    np.testing.assert_allclose(distance_to(solid, mesh.vertices), 0, atol=1e-12)
    inside = distance_to(solid, mesh.corners.mean(axis=1))
    assert inside.max() < 1e-12
    assert inside.min() > -1e-4
    checked = trimesh.Trimesh(mesh.vertices, mesh.triangles)  # joins equal vertices, drops empty triangles
    assert checked.is_watertight
    assert np.array_equal(np.unique(np.asarray(checked.faces).ravel()), np.arange(len(checked.vertices)))
    a, b, c = solid.half_size
    volume = {"box": 8 * a * b * c, "sphere": 4 / 3 * np.pi * a**3, "cylinder": 2 * np.pi * a**2 * c}[kind]
    assert abs(checked.volume) == pytest.approx(volume, rel=2e-3)


def test_the_rooms_mesh_looks_like_the_room(backend: str) -> None:
    from taichi_mrf.datasets.synthetic.analytic_render import render

    scene, T = room_scene(), camera_pose(0.4)
    expected, _ = render(scene, CAMERA, T, color=False)
    off = np.abs(MeshScene(scene_mesh(scene)).render_depth(CAMERA, T) - expected)
    assert np.median(off) < 1e-6
    assert (off > 1e-4).mean() < 0.005  # the rims of round things


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_formats(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"room.{suffix}"
    trimesh.creation.box(ROOM).export(path)
    mesh = load_mesh(path)
    assert mesh.corners.shape == (12, 3, 3)
    np.testing.assert_allclose(np.abs(mesh.corners).max(axis=(0, 1)), np.array(ROOM) / 2, atol=1e-6)


def test_a_source_is_a_sequence_with_the_truth_beside_it(files: tuple[Path, Path]) -> None:
    mesh, poses = files
    source = f"mesh:{mesh}?poses={poses}&width=160&height=120"
    dataset = open_dataset(source)
    assert isinstance(dataset, MeshSequence)
    assert dataset.camera == CAMERA
    assert list(dataset.frame_names) == ["room-0000", "room-0001"]
    for index, T in enumerate(POSES):
        frame = dataset.read(index)
        np.testing.assert_allclose(frame.T_world_camera, T, atol=1e-12)
        np.testing.assert_array_equal(frame.depth_m, dataset.clean_depth(index))
        np.testing.assert_allclose(frame.depth_m, depth_in_box(CAMERA, T, ROOM), atol=1e-5)
        assert frame.stamp == index
    other = PinholeCamera(8, 8, 7, 7, 3.5, 3.5)
    assert open_dataset(source, camera=other).read(0).depth_m.shape == (8, 8)
    wide = open_dataset(f"{source}&fx=50&fy=60&cx=70&cy=80").camera
    assert wide == PinholeCamera(160, 120, 50, 60, 70, 80)


@pytest.mark.parametrize(("noise", "sensor"), [("kinect", KINECT_1), ("kinect-lateral", KINECT_1_LATERAL)])
def test_noise_depends_on_seed_and_frame_alone(files: tuple[Path, Path], noise: str, sensor: object) -> None:
    source = f"mesh:{files[0]}?poses={files[1]}&width=160&height=120&seed=5&noise={noise}"
    dataset = open_dataset(source)
    assert isinstance(dataset, MeshSequence)
    expected = simulate(dataset.clean_depth(1), CAMERA, sensor, seed=(5, 1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(dataset.read(1).depth_m, expected)
    np.testing.assert_array_equal(open_dataset(source).read(1).depth_m, expected)
    assert (open_dataset(source.replace("seed=5", "seed=6")).read(1).depth_m != expected).any()


def test_the_command_line_maps_a_mesh(files: tuple[Path, Path], tmp_path: Path) -> None:
    source = f"mesh:{files[0]}?poses={files[1]}&width=80&height=60"
    done = taichi_mrf("map", source, "--out", tmp_path / "out", "--voxel-size", "0.2", "--no-pictures")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "map.npz").is_file()


@pytest.mark.parametrize(
    ("query", "problem"),
    [
        ("", "needs ?poses=FILE"),
        ("?poses=", "needs ?poses=FILE"),
        ("?noise=none", "needs ?poses=FILE"),
        ("?poses={poses}&noise=some", "noise must be one of none, kinect, kinect-lateral"),
        ("?poses={poses}&pose=1", "unknown parameter 'pose'; did you mean 'poses'?"),
        ("?poses={poses}&width=2", "width must be at least 8"),
        ("?poses={poses}&fx=-3", "focal lengths"),
        ("?poses={poses}&=3", "name=value"),
        ("?poses={poses}.gone", "poses.txt.gone: there is no such file"),
    ],
)
def test_wrong_options(files: tuple[Path, Path], query: str, problem: str) -> None:
    refused(f"mesh:{files[0]}{query.format(poses=files[1])}", problem)


def test_meshes_that_are_none(files: tuple[Path, Path], tmp_path: Path) -> None:
    query = f"?poses={files[1]}"
    refused(f"mesh:{query}", "needs a file")
    refused(f"mesh:{tmp_path / 'gone.ply'}{query}", f"{tmp_path / 'gone.ply'}: the mesh is missing")
    (tmp_path / "folder.ply").mkdir()
    refused(f"mesh:{tmp_path / 'folder.ply'}{query}", "folder.ply: is not a file")
    refused(f"mesh:{files[0]}{query}", "depth_scale", depth_scale=5000)
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    refused(f"mesh:{tmp_path / 'cloud.ply'}{query}", "cloud.ply: contains no triangles")
    contents = {
        "nonsense.ply": (b"this is no mesh", "cannot be read as a mesh"),
        "cut.ply": (files[0].read_bytes()[:250], "cannot be read as a mesh"),
        "mesh.unknown": (b"", "cannot be read as a mesh"),
        "word.ply": (PLY_OF_ONE_TRIANGLE.replace(b"3 0 1 2", b"[" * 5000), "cannot be read as a mesh"),
        "empty.obj": (b"", ""),
        "points.obj": (b"v 0 0 0\nv 1 0 0\n", ""),
        "nan.off": (b"OFF\n3 1 0\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "not finite"),
        "index.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "cannot be read as a mesh"),
        "index.ply": (PLY_OF_ONE_TRIANGLE.replace(b"3 0 1 2", b"3 0 1 7"), "names vertex 7 of 3"),
    }
    for name, (content, problem) in contents.items():
        path = tmp_path / name
        path.write_bytes(content)
        text = refused(f"mesh:{path}{query}")
        assert text.startswith(str(path))
        assert problem in text
        assert len(text) < 1000


def test_a_bad_pose_costs_its_own_frame_only(files: tuple[Path, Path]) -> None:
    files[1].write_text(files[1].read_text() + "\n" + " ".join(["2"] * 12))
    dataset = open_dataset(f"mesh:{files[0]}?poses={files[1]}&width=16&height=12")
    assert len(dataset) == 3
    assert (dataset.read(1).depth_m > 0).all()
    bad_frame(dataset, 2, "poses.txt line 3: the rotation")


@pytest.mark.parametrize("missing", ["trimesh", "embreex"])
def test_without_a_library_one_line_says_what_to_install(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    for name in [missing, *(name for name in sys.modules if name.startswith(f"{missing}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    text = refused(f"mesh:{files[0]}?poses={files[1]}")
    assert text == f"meshes need {missing}, which is not installed: pip install 'taichi-mrf[mesh]'"
    assert mesh_scene.__name__ in sys.modules  # importing the reader itself needs neither


@pytest.mark.shared_data
def test_the_house_is_rendered_as_it_was_recorded(shared_data: Path) -> None:
    folder = shared_data / "house_livingroom"
    rendered = open_dataset(f"mesh:{shared_data}/meshes/house.ply?poses={folder}/T_world_camera.txt")
    recorded = open_dataset(folder)
    assert isinstance(rendered, MeshSequence)
    assert rendered.camera == recorded.camera
    off = []
    for index in (0, 7, 20, 33):
        clean, known = rendered.clean_depth(index).astype(np.float64), recorded.read(index).depth_m
        assert (clean[known > 0] > 0).all()
        assert (clean[(known == 0) & (clean > 0)] > 9.999).all()  # it was recorded up to 10 m
        off.append(np.abs(clean - known)[known > 0])
    difference = np.concatenate(off)
    assert np.median(difference) < 1e-4  # half of the images' step of 0.2 mm
    assert (difference > 5e-3).mean() < 1e-4
