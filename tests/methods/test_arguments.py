"""The public face: a wrong argument is a TypeError or a ValueError of this package that names it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taichi_mrf as tm
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.errors import CapacityError, ConfigError, TaichiMRFError

CAMERA = tm.PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)
DEPTH = np.full(CAMERA.shape, 2.0, np.float32)
MAPS = (tm.MRFMap, tm.LogOddsMap, tm.VisibilityMap)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((40.5, 30, 40.0, 40.0, 1.0, 1.0), "camera width must be a whole number, not 40.5"),
        ((40, "30", 40.0, 40.0, 1.0, 1.0), "camera height must be a whole number, not '30'"),
        ((40, 30, None, 40.0, 1.0, 1.0), "camera fx must be a number, not None"),
    ],
)
def test_a_camera_names_what_is_wrong(values: tuple[Any, ...], message: str) -> None:
    with pytest.raises(TypeError, match=message) as caught:
        tm.PinholeCamera(*values)
    assert isinstance(caught.value, ConfigError)


def test_a_camera_takes_numbers_of_numpy() -> None:
    camera = tm.PinholeCamera(np.int64(40), np.int32(30), np.float32(40), 40, np.float64(1), 1)
    assert camera.shape == (30, 40)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"voxel_size": "0.1"}, "voxel_size must be a number, not '0.1'"),
        ({"voxel_size": None}, "voxel_size must be a number, not None"),
        ({"voxel_size": True}, "voxel_size must be a number, not True"),
        ({"noise": "kinect"}, "noise must be a noise model such as PolynomialNoise, not 'kinect'"),
        ({"volume": 3}, "volume must be of type VolumeConfig, not 3"),
        ({"max_depth": "far"}, "max_depth must be a number, not 'far'"),
    ],
)
@pytest.mark.parametrize("kind", MAPS)
def test_a_constructor_names_what_is_wrong(
    one_backend: str, kind: type, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message) as caught:
        kind(**arguments)
    assert isinstance(caught.value, TaichiMRFError)


@pytest.mark.parametrize("kind", MAPS)
def test_a_map_is_made_from_a_configuration_and_a_camera(one_backend: str, kind: type) -> None:
    with pytest.raises(TypeError, match="config must be a Config, not None"):
        kind.from_config(None, CAMERA)
    with pytest.raises(TypeError, match="camera must be a camera such as PinholeCamera, not None"):
        kind.from_config(tm.Config(), None)


def test_a_parameter_of_the_wrong_type_is_named(one_backend: str) -> None:
    with pytest.raises(TypeError, match="MRFMap: surface_density must be a number, not '2'"):
        tm.MRFMap(surface_density="2")
    with pytest.raises(ConfigError, match="LogOddsMap: hit must be of type float"):
        tm.LogOddsMap(hit=[0.7])
    assert tm.LogOddsMap(hit=np.float32(0.75)).config.log_odds.hit == 0.75


def calls(m: Any) -> dict[str, tuple[type[Exception], Callable[[], object]]]:
    """Wrong calls of a map, by what the error says."""
    eye = np.eye(4)
    return {
        "camera must be a camera such as PinholeCamera, not None": (
            TypeError,
            lambda: m.add_keyframe(DEPTH, eye, None),
        ),
        "name must be a string, not 5": (TypeError, lambda: m.add_keyframe(DEPTH, eye, CAMERA, name=5)),
        "sweeps must be at least 0, not -1": (ValueError, lambda: m.infer(sweeps=-1)),
        "sweeps must be a whole number, not 1.5": (TypeError, lambda: m.infer(sweeps=1.5)),
        "tolerance must be at least 0, not nan": (ValueError, lambda: m.infer(tolerance=float("nan"))),
        "keyframes must be a list of keyframe ids, not 3": (TypeError, lambda: m.infer(keyframes=3)),
        "min_probability must be a number, not 'a'": (TypeError, lambda: m.voxels("a")),
        "points must be an array of numbers, not 'abc'": (TypeError, lambda: m.occupancy("abc")),
        "camera must be a camera such as PinholeCamera, not 3": (TypeError, lambda: m.render_depth(3, eye)),
        "max_range must be more than 0, not -1": (ValueError, lambda: m.ray_profile([0] * 3, [1, 0, 0], -1)),
        "direction must be an array of numbers": (TypeError, lambda: m.ray_profile([0, 0, 0], "ahead")),
    }


@pytest.mark.parametrize("kind", MAPS)
def test_a_call_names_what_is_wrong_and_changes_nothing(one_backend: str, kind: type) -> None:
    m = kind(0.2)
    for message, (error, call) in calls(m).items():
        with pytest.raises(error, match=message) as caught:
            call()
        assert isinstance(caught.value, TaichiMRFError)
    assert not m.keyframes
    assert m.settled


@pytest.mark.parametrize("far", [1e6, 1e12, 1e16, 1e17, 1e30, 1e300])
@pytest.mark.parametrize("kind", MAPS)
def test_a_pose_out_of_reach_is_refused(one_backend: str, kind: type, far: float) -> None:
    m, T_world_camera = kind(0.2), np.eye(4)
    T_world_camera[1, 3] = -far
    with pytest.raises(CapacityError, match="from the world's origin"):
        m.add_keyframe(DEPTH, T_world_camera, CAMERA)
    assert not m.keyframes


def test_noise_names_its_coefficients() -> None:
    with pytest.raises(TypeError, match="sigma must be an array of numbers, not 'a'"):
        tm.PolynomialNoise("a")


def test_exports_name_what_is_no_map(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"m must be a map, or a part of one from take_part, not None"):
        tm.export_map(None, tmp_path / "map.ply")  # type: ignore[arg-type]


@pytest.mark.parametrize("stamp_s", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", MAPS)
def test_a_stamp_is_a_time(one_backend: str, kind: type, stamp_s: float) -> None:
    m = kind(0.1)
    with pytest.raises(ValueError, match="stamp_s must be a finite number of seconds"):
        m.add_keyframe(DEPTH, np.eye(4), CAMERA, stamp_s=stamp_s)
    assert not m.keyframes
    if kind is tm.MRFMap:
        dated = tm.MRFMap(0.1, time=TimeConfig(half_life_s=600.0))
        with pytest.raises(ValueError, match="stamp_s must be a finite number of seconds"):
            dated.at(stamp_s)
