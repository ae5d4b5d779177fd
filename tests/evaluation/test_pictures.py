"""The pictures of a run: what they show of a room whose every voxel is known."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps
from numpy.typing import NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.config.registry import METHODS
from taichi_mrf.errors import MapFileError
from taichi_mrf.evaluation.pictures.raster import cast_voxels
from taichi_mrf.evaluation.pictures.room_views import DrawnMap, top_view
from taichi_mrf.evaluation.pictures.run_pictures import depth_comparison, write_pictures
from taichi_mrf.evaluation.pictures.surfaces import level_rotation, seen_surfaces, up_direction, upward_axis
from taichi_mrf.evaluation.pictures.viewpoint import faces_viewer, overview_pose
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(width=160, height=120, fx=90.0, fy=90.0, cx=79.5, cy=59.5)
KITCHEN = Path(__file__).resolve().parents[3] / "shared" / "data" / "seven_scenes_redkitchen"
VOXEL = 0.05
LENGTH, WIDTH, HEIGHT = 4.0, 3.0, 2.4
TABLE_HEIGHT = 0.8


@dataclass
class VoxelMap:
    """A map made of known voxels."""

    METHOD: ClassVar[Method] = METHODS["log_odds"]
    centres: NDArray[np.float64]
    probability: NDArray[np.float32]
    keyframes: dict[int, Frame]
    voxel_size: float = VOXEL
    up: None = None
    noise: NoiseModel = field(default_factory=lambda: PolynomialNoise((0.01,)))

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        shown = self.probability >= min_probability
        return self.centres[shown], self.probability[shown]

    @property
    def decided(self) -> "VoxelMap":
        return self

    def render_depth(
        self, camera: PinholeCamera, T_world_camera: Pose, by: str = "surface"
    ) -> NDArray[np.float32]:
        return cast_voxels(self.centres, self.voxel_size, camera, T_world_camera).depth_m


def _room() -> VoxelMap:
    """A closed box (floor, walls and ceiling two voxels thick) with a table, seen from inside."""
    size = np.rint(np.array([LENGTH, WIDTH, HEIGHT]) / VOXEL).astype(int)
    solid = np.ones(size + 4, bool)
    solid[2:-2, 2:-2, 2:-2] = False
    i, j, k = np.ogrid[tuple(slice(0, n + 4) for n in size)]
    x, y, z = ((index - 1.5) * VOXEL for index in (i, j, k))
    solid |= (np.abs(x - 2.0) < 0.6) & (np.abs(y - 1.5) < 0.4) & (np.abs(z - TABLE_HEIGHT + 0.1) < 0.1)
    centres = (np.argwhere(solid) - 1.5) * VOXEL
    probability = np.random.default_rng(0).uniform(0.6, 1.0, len(centres)).astype(np.float32)
    m = VoxelMap(centres, probability, {})
    corners = [(0.5, 0.5), (3.5, 0.5), (3.5, 2.5), (0.5, 2.5)]
    for number, (cx, cy) in enumerate(corners * 3):
        target = (2.0, 1.5, (0.4, 1.2, 2.2)[number // 4])
        pose = look_at((cx, cy, 1.4), target)
        m.keyframes[7 + number] = Frame(m.render_depth(CAMERA, pose), pose, CAMERA, 0.0, f"view {number}")
    return m


@pytest.fixture(scope="module")
def room() -> VoxelMap:
    return _room()


def _held_out(m: VoxelMap, offset_m: float) -> Frame:
    pose = look_at((0.6, 1.5, 1.2), (3.0, 1.5, 0.9))
    depth_m = np.nan_to_num(m.render_depth(CAMERA, pose) + np.float32(offset_m))
    return Frame(depth_m, pose, CAMERA, 0.0, "frame-000123")


def _read(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


@pytest.mark.usefixtures("full_pictures")
def test_pictures_are_written(room: VoxelMap, tmp_path: Path) -> None:
    paths = write_pictures(tmp_path, room, [_held_out(room, 0.0)])
    assert {path.name for path in paths} == {"top_view.png", "depth.png", "perspective.png"}
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in paths}
    for path in paths:
        picture = _read(path)
        assert min(picture.shape[:2]) >= 350
        assert max(picture.shape[:2]) >= 1200
        assert 0.2 < np.mean((picture < 250).any(axis=-1)) < 0.95, f"{path.name} is blank or full"
        assert (picture[:4] == 255).all(), "on white paper"


def _notices(folder: Path, m: VoxelMap) -> None:
    for path in write_pictures(folder, m, []):
        picture = _read(path)
        assert 0.001 < np.mean(picture < 128) < 0.2, f"{path.name} holds a line of text and nothing else"


EMPTY = VoxelMap(np.zeros((0, 3)), np.zeros(0, np.float32), {})


def test_empty_map_says_so(tmp_path: Path) -> None:
    _notices(tmp_path, EMPTY)


@pytest.mark.parametrize("count", [1, 2])
def test_few_voxels_and_no_keyframes(tmp_path: Path, count: int) -> None:
    centres = np.array([[10.0, -3.0, 1.0], [10.0, -3.0, 1.05]])[:count]
    for path in write_pictures(tmp_path, VoxelMap(centres, np.ones(count, np.float32), {}), []):
        picture = _read(path)
        assert np.mean(picture < 250) > 0.005


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"\.png: cannot be written"):
        write_pictures(tmp_path / "absent", EMPTY, [])


def _titles(m: VoxelMap, held_out: Sequence[Frame]) -> list[str]:
    return [axes.get_title() for axes in depth_comparison(m, held_out).axes if axes.get_title()]


def test_depth_comparison_names_frame_and_error(room: VoxelMap) -> None:
    measured, rendered, difference = _titles(room, [_held_out(room, -0.03)])
    assert "held-out frame frame-000123" in measured
    assert "0.0 % without" in rendered
    assert "error 3.0 cm, signed +3.0 cm" in difference


def test_depth_comparison_takes_the_bias_of_the_sensor_from_measurements(room: VoxelMap) -> None:
    biased = replace(room, noise=PolynomialNoise((0.01,), bias=(-0.03,)))
    assert "median error 0.0 cm" in _titles(biased, [_held_out(room, -0.03)])[2]
    own = replace(_held_out(room, 0.05), noise=PolynomialNoise((0.01,), bias=(0.05,)))
    assert "median error 0.0 cm" in _titles(biased, [own])[2]


def test_depth_comparison_takes_a_keyframe_where_nothing_is_held_out(room: VoxelMap) -> None:
    assert "keyframe view 6" in _titles(room, [])[0]
    assert len(_titles(room, [_held_out(room, 0.0)] * 20)) == 9


def test_depth_comparison_without_any_measurement(room: VoxelMap) -> None:
    frame = Frame(np.zeros((120, 160), np.float32), look_at((9, 9, 9), (20, 20, 20)), CAMERA, 0.0, "dark")
    assert "dark" in _titles(room, [frame])[0]


def test_surfaces_face_where_they_were_seen_from(room: VoxelMap) -> None:
    surfaces = seen_surfaces(room)
    floor = surfaces.normals_at(np.array([[1.0, 1.0, -VOXEL / 2], [3.2, 2.2, -VOXEL / 2]]))
    ceiling = surfaces.normals_at(np.array([[2.0, 1.5, HEIGHT + VOXEL / 2]]))
    wall = surfaces.normals_at(np.array([[-VOXEL / 2, 1.5, 1.5]]))
    assert (floor @ [0, 0, 1] > 0.95).all()
    assert (ceiling @ [0, 0, -1] > 0.95).all()
    assert (wall @ [1, 0, 0] > 0.95).all()
    assert (surfaces.normals_at(np.array([[50.0, 0.0, 0.0]])) == 0).all()
    # The outer layer of the two is never seen, yet belongs to the same surfaces.
    known = (surfaces.thickened().normals_at(room.centres) != 0).any(axis=1)
    assert known.mean() > 0.97


def test_no_keyframes_no_surfaces() -> None:
    surfaces = seen_surfaces(VoxelMap(np.zeros((1, 3)), np.ones(1, np.float32), {}))
    assert surfaces.normals.shape == (0, 3)
    assert (surfaces.thickened().normals_at(np.zeros((2, 3))) == 0).all()


@given(seed=st.integers(0, 2**32 - 1), pitch_deg=st.floats(0, 35))
def test_up_is_found_though_the_camera_looked_down(seed: int, pitch_deg: float) -> None:
    rng = np.random.default_rng(seed)
    R_world_level = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R_world_level[:, 0] *= np.linalg.det(R_world_level)
    up = R_world_level[:, 2]
    poses = []
    for heading in rng.uniform(-0.5, 0.5, 8):
        forward = np.array([np.cos(heading), np.sin(heading), -np.tan(np.deg2rad(pitch_deg))])
        T = look_at((0.0, 0.0, 0.0), forward)
        T[:3, :3] = R_world_level @ T[:3, :3]
        poses.append(T)
    level = [[0, 0, 1]] * 40 + [[0, 0, -1]] * 10
    upright = [[np.cos(a), np.sin(a), 0] for a in rng.uniform(0, 2 * np.pi, 60)]
    normals = np.array(level + upright) + rng.normal(0, 0.05, (110, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = up_direction([-T[:3, 1] for T in poses], normals @ R_world_level.T)
    assert np.rad2deg(np.arccos(min(1.0, found @ up))) < 3.0


def test_up_without_surfaces_or_cameras() -> None:
    T = look_at((0, 0, 0), (1, 0, 0), (0, 1, 0))
    np.testing.assert_allclose(up_direction([-T[:3, 1]] * 2, np.zeros((0, 3))), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(up_direction([], np.zeros((0, 3))), [0, 0, 1])


@given(seed=st.integers(0, 2**32 - 1))
def test_level_rotation(seed: int) -> None:
    up = np.random.default_rng(seed).normal(size=3)
    up /= np.linalg.norm(up)
    R = level_rotation(up)
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(level_rotation(np.array([0.0, 0.0, -1.0])) @ [0, 0, -1], [0, 0, 1])


def _as_room(m: VoxelMap) -> DrawnMap:
    surfaces = seen_surfaces(m)
    poses = [keyframe.T_world_camera for keyframe in m.keyframes.values()]
    normals = surfaces.thickened().normals_at(m.centres)
    up = up_direction(map(upward_axis, m.keyframes.values()), surfaces.normals)
    return DrawnMap(m.centres, normals, m.voxel_size, up, poses)


def test_top_view_looks_through_the_ceiling(room: VoxelMap) -> None:
    drawn = _as_room(room)
    np.testing.assert_allclose(drawn.up, [0, 0, 1], atol=0.02)
    axes = top_view(drawn).axes[0]
    picture = np.asarray(axes.images[0].get_array()).astype(float)
    left, right, bottom, top = axes.images[0].get_extent()
    assert (right - left) / (top - bottom) == pytest.approx(picture.shape[1] / picture.shape[0], rel=0.01)

    def color_at(x: float, y: float) -> NDArray[np.float64]:
        row = int((top - y) / (top - bottom) * picture.shape[0])
        column = int((x - left) / (right - left) * picture.shape[1])
        return picture[row, column] / np.linalg.norm(picture[row, column])

    def scale(height_m: float) -> NDArray[np.float64]:
        walls = HEIGHT + VOXEL  # what remains of the highest surfaces
        rgb = np.array(colormaps["Spectral_r"]((height_m + VOXEL / 2) / walls)[:3])
        return rgb / np.linalg.norm(rgb)

    for point, height in (((0.5, 0.5), 0.0), ((3.5, 2.5), 0.0), ((2.0, 1.5), TABLE_HEIGHT)):
        assert color_at(*point) @ scale(height) > 0.99, f"{point}: not the colour of {height} m"
    assert color_at(2.0, 1.5) @ scale(0.0) < 0.97, "the table differs from the floor"


def test_overview_sees_into_the_room(room: VoxelMap) -> None:
    drawn = _as_room(room)
    camera = CAMERA.scaled(2.0)
    pose = overview_pose(drawn.centres, drawn.normals, drawn.up, camera, VOXEL)
    eye = pose[:3, 3]
    assert eye[2] > HEIGHT, "from above"
    front = faces_viewer(drawn.centres, drawn.normals, eye)
    image = cast_voxels(drawn.centres[front], VOXEL, camera, pose)
    seen = np.zeros(len(drawn.centres), bool)
    seen[np.flatnonzero(front)[image.index[image.index >= 0]]] = True
    x, y, z = drawn.centres.T
    inside = (x > 0.4) & (x < LENGTH - 0.4) & (y > 0.4) & (y < WIDTH - 0.4)
    assert seen[inside & (np.abs(z - TABLE_HEIGHT) < VOXEL)].mean() > 0.9, "the top of the table"
    assert seen[inside & (np.abs(z + VOXEL / 2) < VOXEL / 4)].mean() > 0.6, "the floor that it does not hide"
    assert not seen[inside & (z > HEIGHT)].any(), "the ceiling is gone"
    assert 0.2 < np.mean(image.index >= 0) < 0.9, "it fills the picture and fits in"


@pytest.mark.shared_data
@pytest.mark.skipif(not KITCHEN.is_dir(), reason="../shared/data/seven_scenes_redkitchen is absent")
def test_up_of_a_real_room() -> None:
    """Against the gravity that comes with the recording, whose camera looked down all the time."""
    camera = PinholeCamera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
    keyframes, points = {}, []
    for number in range(0, 1000, 100):
        raw = cv2.imread(str(KITCHEN / f"frame-{number:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        depth_m = np.where(raw == 65535, 0, raw).astype(np.float32) / 1000
        pose = np.loadtxt(KITCHEN / f"frame-{number:06d}.pose.txt")
        keyframes[number] = Frame(depth_m, pose, camera, 0.0, str(number))
        measured = (depth_m > 0) & (depth_m < 4.0)
        measured &= np.add.outer(np.arange(480) % 4, np.arange(640) % 4) == 0  # 3 cm apart, in voxels of 5
        points.append((camera.rays() * depth_m[..., None])[measured] @ pose[:3, :3].T + pose[:3, 3])
    cells = np.unique(np.floor(np.concatenate(points) / VOXEL), axis=0)
    m = VoxelMap((cells + 0.5) * VOXEL, np.ones(len(cells), np.float32), keyframes)
    gravity = np.loadtxt(KITCHEN / "gravity-direction.txt")
    axes = [upward_axis(frame) for frame in keyframes.values()]

    def error_deg(normals: NDArray[np.floating]) -> float:
        return float(np.rad2deg(np.arccos(-gravity @ up_direction(axes, normals))))

    assert error_deg(np.zeros((0, 3))) > 15.0
    assert error_deg(seen_surfaces(m).normals) < 4.0
