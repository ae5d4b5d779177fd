"""Missing returns in a log-odds map: misses from the minimum range up to where they count, and no further."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import LogOddsConfig
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.ray_table import RayTable

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(width=26, height=19, fx=22, fy=23, cx=12.3, cy=9.4)
VOXEL, REACH_M = 0.05, 3.0
T = look_at((0.317, -0.213, 0.104), (2.0, 1.5, -0.4))
NOTHING = np.zeros(CAMERA.shape, np.float32)
ALL = np.ones(CAMERA.shape, bool)


def wall() -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A rough wall, and the pixels in the middle, without a measurement."""
    depth = (1.5 + 0.3 * np.random.default_rng(0).random(CAMERA.shape)).astype(np.float32)
    missing = np.zeros(CAMERA.shape, bool)
    missing[5:14, 6:20] = True
    depth[missing] = 0.0
    return depth, missing


def log_odds_map(no_return: str = "free", min_depth: float = 0.01, **options: Any) -> LogOddsMap:
    sensor = SensorConfig(
        min_depth=min_depth, max_depth=REACH_M, no_return=no_return, no_return_depth=REACH_M
    )  # type: ignore[arg-type]
    return LogOddsMap.from_config(
        Config(voxel_size=VOXEL, sensor=sensor, log_odds=LogOddsConfig(**options)), CAMERA
    )


def contents(m: LogOddsMap) -> bytes:
    centres, p = m.voxels(0.0)
    order = np.lexsort(centres.T)
    return centres[order].tobytes() + p[order].tobytes()


@pytest.mark.parametrize(
    "options", [{}, {"update": "ray"}, {"max_range": 2.0}, {"update": "ray", "max_range": 2.0}]
)
def test_a_missing_return_is_a_measurement_beyond_the_reach(options: dict[str, Any]) -> None:
    depth, missing = wall()
    m, beyond = log_odds_map(**options), log_odds_map("ignore", **options)
    m.add_keyframe(depth, T, CAMERA, no_return=missing)
    beyond.add_keyframe(np.where(missing, np.float32(99.0), depth), T, CAMERA)
    if options.get("update") == "ray":  # the camera's own voxel lies before the minimum range
        inside = (T[:3, 3] + 0.3 * CAMERA.rays()[missing] @ T[:3, :3].T).reshape(-1, 3)
        np.testing.assert_array_equal(m.occupancy(inside), beyond.occupancy(inside))
    else:
        assert contents(m) == contents(beyond)
    without = log_odds_map(**options)
    without.add_keyframe(depth, T, CAMERA)
    assert contents(without) != contents(m)


@pytest.mark.parametrize("options", [{}, {"max_range": 2.0}, {"discretise": True, "max_range": 0.8}])
def test_nothing_is_free_below_the_minimum_range_nor_beyond_the_reach(options: dict[str, Any]) -> None:
    least_m, most_m = 1.0, options.get("max_range", np.inf)
    m = log_odds_map(min_depth=least_m, **options)
    m.add_keyframe(NOTHING, T, CAMERA, no_return=ALL)
    centres, p = m.voxels(0.0)
    if most_m < least_m:
        assert len(centres) == 0
        return
    assert (p < 0.5).all()
    seen = (centres - T[:3, 3]) @ T[:3, :3]
    corner = np.sqrt(3) / 2 * VOXEL
    assert seen[:, 2].min() > least_m - corner
    assert seen[:, 2].max() < REACH_M + corner
    assert np.linalg.norm(seen, axis=1).max() < most_m + corner
    # Every ray frees its way in between.
    rays = CAMERA.rays().reshape(-1, 3) @ T[:3, :3].T
    for depth_m in (1.1, 1.5):
        assert (m.state(T[:3, 3] + depth_m * rays) == FREE).all()


def test_hits_of_the_same_scan_win_and_other_scans_count() -> None:
    depth, missing = wall()
    m = log_odds_map()
    m.add_keyframe(depth, T, CAMERA)
    surface = T[:3, 3] + (CAMERA.rays()[~missing] * depth[~missing][:, None]) @ T[:3, :3].T
    assert (m.state(surface) == OCCUPIED).all()
    m.add_keyframe(NOTHING, T, CAMERA, no_return=ALL)
    m.add_keyframe(NOTHING, T, CAMERA, no_return=ALL)
    assert (m.occupancy(surface) < 0.7).all()
    both = log_odds_map()
    both.add_keyframe(depth, T, CAMERA, no_return=missing)
    assert (both.state(surface) == OCCUPIED).all()


@pytest.mark.parametrize("no_return", ["ignore", "model"])
def test_otherwise_they_are_ignored(no_return: str) -> None:
    depth, missing = wall()
    m, plain = log_odds_map(no_return), log_odds_map("ignore")
    id = m.add_keyframe(depth, T, CAMERA, no_return=missing)
    plain.add_keyframe(depth, T, CAMERA)
    assert contents(m) == contents(plain)
    assert m.keyframes[id].own.no_return is None


def test_they_are_saved_and_integrated_again(tmp_path: Path) -> None:
    depth, missing = wall()
    m = log_odds_map()
    first = m.add_keyframe(depth, look_at((0, 0, 0), (1, 0, 0)), CAMERA, no_return=missing)
    m.add_keyframe(depth, T, CAMERA, no_return=missing)
    middle = (T[:3, 3] + 2.5 * CAMERA.rays()[9, 13] @ T[:3, :3].T)[None]
    assert m.state(middle)[0] == FREE
    m.save(tmp_path / "map.npz")
    loaded = LogOddsMap.load(tmp_path / "map.npz")
    assert contents(loaded) == contents(m)
    for each in (m, loaded):
        each.remove_keyframe(first)
        each.infer()
    straight = log_odds_map()
    straight.add_keyframe(depth, T, CAMERA, no_return=missing)
    assert contents(loaded) == contents(m) == contents(straight)
    assert loaded.state(middle)[0] == FREE
    loaded.remove_keyframe(next(iter(loaded.keyframes)))
    loaded.infer()
    assert loaded.state(middle)[0] == UNKNOWN


def test_rays_of_a_moving_sensor_start_where_it_was() -> None:
    """A sensor that is a quarter of a metre beside its pose all the time, as one that moves has it."""
    offset_m = np.array([0.25, 0.0, 0.0])
    still = RayTable(CAMERA.rays())
    moving = RayTable(CAMERA.rays(), np.tile(offset_m, (CAMERA.width, 1)))
    T_beside = T.copy()
    T_beside[:3, 3] += T[:3, :3] @ offset_m
    depth, missing = wall()
    maps = [log_odds_map(min_depth=0.5, max_range=2.5) for _ in range(2)]
    maps[0].add_keyframe(depth, T, moving, no_return=missing)
    maps[1].add_keyframe(depth, T_beside, still, no_return=missing)
    ways = CAMERA.rays()[missing] @ T[:3, :3].T
    for depth_m, state in ((2.0, FREE), (2.7, UNKNOWN)):
        for m in maps:
            assert (m.state(T_beside[:3, 3] + depth_m * ways) == state).mean() > 0.97
    centres, p = maps[1].voxels(0.0)
    assert (np.abs(maps[0].occupancy(centres) - p) < 1e-5).mean() > 0.99


@pytest.mark.parametrize(
    ("method", "no_return"),
    [("wavemap", "free"), ("visibility", "free"), ("wavemap", "model"), ("log_odds", "model")],
)
def test_a_setting_without_effect_is_said(method: str, no_return: Any) -> None:
    depth, missing = wall()
    sensor = SensorConfig(max_depth=REACH_M, no_return=no_return)
    m = create_map(Config(VOXEL, method, sensor=sensor), CAMERA)
    with pytest.warns(UserWarning, match=f"{no_return} has no effect: a map of the method {method}.*126 pix"):
        m.add_keyframe(depth, T, CAMERA, no_return=missing)


@pytest.mark.parametrize(
    ("method", "no_return"), [("wavemap", "ignore"), ("visibility", "ignore"), ("log_odds", "free")]
)
def test_nothing_is_said_of_a_setting_that_is_kept(
    method: str, no_return: Any, recwarn: pytest.WarningsRecorder
) -> None:
    depth, missing = wall()
    sensor = SensorConfig(max_depth=REACH_M, no_return=no_return, no_return_depth=REACH_M)
    m = create_map(Config(VOXEL, method, sensor=sensor), CAMERA)
    m.add_keyframe(depth, T, CAMERA, no_return=missing)
    assert not [each for each in recwarn if "no_return" in str(each.message)]
