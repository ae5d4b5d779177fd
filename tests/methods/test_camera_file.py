"""Maps on disk whose keyframes have cameras of all kinds: what is loaded is what was saved."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.map_file import camera_arrays
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.distortion import DistortedCamera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera

pytestmark = pytest.mark.usefixtures("one_backend")

LIDAR = SphericalCamera(
    np.linspace(0.5, -0.5, 12), np.linspace(3.1, -3.1, 40), 0.02 * np.tile([1.0, -1.0], 6)
)
PINHOLE = PinholeCamera(16, 12, 14.0, 14.0, 7.5, 5.5)
TABLE = RayTable(PinholeCamera(12, 10, 9.0, 9.0, 5.0, 5.0).rays())
FREE = RayTable(LIDAR.rays().reshape(-1, 3)[::3])
BENT = DistortedCamera(PINHOLE, (0.05, -0.01, 0.002, 0.001, 0.0))
MOVES = np.tile(np.eye(4), (12, 40, 1, 1))
MOVES[..., 0, 3] = np.linspace(-0.2, 0.2, 40) + 0.001 * np.arange(12)[:, None]
MOVING = RayTable.moving(LIDAR, MOVES[0])
STAGGERED = RayTable.moving(LIDAR, MOVES)
MOVING_FREE = RayTable.moving(FREE, MOVES.reshape(-1, 4, 4)[::3])
CAMERAS: tuple[Camera, ...] = (LIDAR, PINHOLE, TABLE, FREE, LIDAR, BENT, MOVING, STAGGERED, MOVING_FREE)


def build(m: Any, cameras: tuple[Camera, ...] = CAMERAS) -> Any:
    for place, camera in enumerate(cameras):
        T = np.eye(4)
        T[0, 3] = 0.2 * place
        m.add_keyframe(np.full(camera.shape, 1.5, np.float32), T, camera)
    m.infer()
    return m


def probes() -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(-2, 2, (500, 3))


@pytest.mark.parametrize("make", [MRFMap, LogOddsMap, VisibilityMap])
def test_a_map_with_cameras_of_all_kinds_goes_on_after_loading(
    tmp_path: Path, make: Callable[[float], Any]
) -> None:
    m = build(make(0.2))
    assert np.std(m.occupancy(probes())) > 0.05
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    np.testing.assert_array_equal(loaded.occupancy(probes()), m.occupancy(probes()))
    found = [k.camera for k in loaded.keyframes.values()]
    assert found == list(CAMERAS)
    assert [type(camera) for camera in found] == [type(camera) for camera in CAMERAS]
    assert found[0] is found[4]  # so that its table is in memory once
    assert loaded.up == m.up == (2, 1)
    for each in (m, loaded):
        each.remove_keyframe(3)
        each.infer()
    np.testing.assert_array_equal(loaded.occupancy(probes()), m.occupancy(probes()))


def test_a_map_of_pinholes_is_readable_by_earlier_versions(tmp_path: Path) -> None:
    build(MRFMap(0.2), (PINHOLE, PINHOLE)).save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        assert file["format"] == 2
        assert file["keyframe_cameras"].tolist() == [[16, 12, 14, 14, 7.5, 5.5]] * 2
    build(MRFMap(0.2), (PINHOLE, LIDAR)).save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        assert file["format"] == 3


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("camera_0_elevations_rad", np.zeros(11), "azimuth_offsets_rad has 12 values"),
        ("camera_0_azimuths_rad", np.full(40, np.nan), "camera_0_azimuths_rad holds a value"),
        ("camera_2_directions", np.zeros((10, 12, 3), np.float32), "column 0, row 0"),
        ("camera_3_free_directions", np.ones((1, 5, 3), np.float32), "keyframe_depth_3"),
        (
            "keyframe_camera_numbers",
            np.array([0, 1, 2, 9, 0, 0, 5, 6, 7]),
            "camera_9_free_directions is missing",
        ),
        ("camera_5_origins_m", np.zeros((2, 40, 3), np.float32), "origins_m must be of shape"),
        ("camera_7_origins_m", np.zeros((0, 160, 3), np.float32), "camera_7_origins_m is"),
    ],
)
def test_a_damaged_camera_is_named(tmp_path: Path, name: str, value: NDArray[Any], words: str) -> None:
    path = tmp_path / "map.npz"
    build(LogOddsMap(0.2)).save(path)
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files if key != "manifest"}
    np.savez(path, **{**arrays, name: value, "format": np.asarray(1)})  # the first format has no manifest
    with pytest.raises(MapFileError, match=words) as caught:
        load_map(path)
    assert str(path) in str(caught.value)


def test_a_camera_of_another_program_is_not_saved_by_mistake() -> None:
    with pytest.raises(MapFileError, match="camera of type SimpleCamera cannot be saved"):
        camera_arrays([type("SimpleCamera", (), {})()])
