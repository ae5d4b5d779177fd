"""Full inference step by step: what a stop leaves, with and without a copy of the map before it."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import small_room
from numpy.typing import NDArray

import taichi_mrf as tm
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import OCCUPIED
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")

KEYFRAMES = 3


def marginals(m: MRFMap | LogOddsMap) -> NDArray[np.float32]:
    return m.marginals.occupancy(small_room.probes())


def incremental() -> MRFMap:
    """A map as a live run has it: each keyframe was swept once when it came."""
    m = MRFMap(small_room.VOXEL_SIZE)
    for frame in small_room.frames()[:KEYFRAMES]:
        m.infer(sweeps=1, keyframes=[small_room.add(m, frame)])
    return m


def settled(m: MRFMap | LogOddsMap, stop_after: int, *, copy: bool, at_once: bool = False) -> FullInference:
    """Inference that is told to stop after some steps; ``copy``: the map before it is kept."""
    taken = 0
    with FullInference(m, keep_before=copy) as inference:
        for _ in inference:
            taken += 1
            if taken >= stop_after:
                inference.stop(at_once)
    return inference


def test_all_steps_are_those_of_infer() -> None:
    m, twin = incremental(), incremental()
    with FullInference(m, keep_before=True) as inference:
        steps = [(step.sweep, step.keyframe) for step in inference]
    twin.infer()
    assert steps == [(sweep, k) for sweep in (1, 2, 3) for k in range(1, KEYFRAMES + 1)]
    assert inference.outcome is not None
    assert inference.outcome.complete
    assert m.settled
    np.testing.assert_array_equal(marginals(m), marginals(twin))


@pytest.mark.parametrize("stop_after", [KEYFRAMES, KEYFRAMES + 1, 2 * KEYFRAMES])
def test_a_stop_after_the_first_sweep_keeps_what_was_computed_with_and_without_a_copy(
    stop_after: int,
) -> None:
    maps = []
    for copy in (False, True):
        m = incremental()
        inference = settled(m, stop_after, copy=copy)
        assert inference.outcome is not None
        assert not inference.outcome.complete
        assert inference.outcome.sweeps == -(-stop_after // KEYFRAMES)
        assert not m.settled
        maps.append(marginals(m))
    np.testing.assert_array_equal(*maps)


def test_a_stop_in_the_first_sweep_goes_back_to_the_copy() -> None:
    m = incremental()
    before = marginals(m)
    assert settled(m, 1, copy=True).outcome is None
    np.testing.assert_array_equal(marginals(m), before)


def test_without_a_copy_the_first_sweep_is_completed() -> None:
    m, twin = incremental(), incremental()
    inference = settled(m, 1, copy=False)
    assert inference.outcome is not None
    assert inference.outcome.sweeps == 1
    twin.infer(sweeps=1)
    np.testing.assert_array_equal(marginals(m), marginals(twin))


def test_without_a_copy_and_time_it_ends_at_once() -> None:
    m = incremental()
    inference = settled(m, 1, copy=False, at_once=True)
    assert inference.outcome is not None
    assert inference.outcome.rays in [keyframe.rays for keyframe in m.keyframes.values()]


def test_the_map_before_is_shown_between_the_steps_and_comes_back_after_an_error() -> None:
    m = incremental()
    before = marginals(m)

    def fail_after_two_keyframes() -> None:
        with FullInference(m, keep_before=True) as inference:
            for step in inference:
                with inference.showing_before():
                    np.testing.assert_array_equal(marginals(m), before)
                assert not np.array_equal(marginals(m), before)
                if step.keyframe == 2:
                    raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_after_two_keyframes()
    np.testing.assert_array_equal(marginals(m), before)
    m.infer()
    np.testing.assert_array_equal(marginals(m), marginals(small_room.build(range(KEYFRAMES))))


def test_what_is_decided_while_a_map_settles_is_what_was_decided_before() -> None:
    """With a sigma of three voxels no marginal is over one half, and the votes alone find the wall."""
    m, draw = MRFMap(0.02, PolynomialNoise((0.06,))), np.random.default_rng(0)
    camera = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
    for x_m in np.linspace(-0.3, 0.3, 5):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = x_m
        depth_m = 3.02 + 0.06 * draw.standard_normal(camera.shape)
        m.add_keyframe(depth_m.astype(np.float32), T_world_camera, camera)
    m.infer()
    wanted = m.decided.voxels(0.5)[0]
    assert len(wanted) > 3 * len(m.marginals.voxels(0.5)[0])
    with FullInference(m, keep_before=True) as inference:
        next(iter(inference))
        with inference.showing_before():
            np.testing.assert_array_equal(m.decided.voxels(0.5)[0], wanted)
            np.testing.assert_array_equal(m.state(wanted), OCCUPIED)


def answers(m: MRFMap | LogOddsMap, folder: Path) -> dict[str, NDArray]:
    """What a user gets of a map: states, decisions, ray casts, exports, and what is in its file."""
    folder.mkdir()
    points, slots = small_room.probes(), m.view.pool.in_order
    found: dict[str, NDArray] = {"state": m.state(points), "marginals": m.occupancy(points)}
    found["decided"] = m.decided.voxels(0.5)[0]
    hits = tm.cast_rays(m, np.zeros(3), np.random.default_rng(0).normal(size=(50, 3)), 10.0)
    found |= {f"rays: {field.name}": np.asarray(getattr(hits, field.name)) for field in fields(hits)}
    found["seen by"] = m.seen_by(slots)
    if isinstance(m, MRFMap):
        found["calibrated"] = m.calibrated().occupancy(points)
        found["surface"], found["calls"] = m.surface().vertices_m, m.first_surfaces()[slots]
        found["colours"] = m.colors_in(slots)
        found["votes"] = np.array(sorted(m.votes_at(points[m.occupancy(points).argmax()]).items()))
    if isinstance(m, MRFMap) and m.config.time.half_life_s:
        found["then"], found["static"] = m.at(1.0).occupancy(points), m.static.occupancy(points)
    for ending in ("bt", "ply"):
        tm.export_map(m, folder / f"map.{ending}")
        found[ending] = np.frombuffer((folder / f"map.{ending}").read_bytes(), np.uint8)
    m.save(folder / "map.npz")
    with np.load(folder / "map.npz") as file:
        found |= {f"file: {name}": file[name] for name in file.files if name != "manifest"}
    return found


def painted(half_life_s: float, swept: int) -> MRFMap:
    """A map with colours, all or some of whose keyframes were swept."""
    m = MRFMap(small_room.VOXEL_SIZE, time=TimeConfig(half_life_s=half_life_s))
    for number, frame in enumerate(small_room.frames()[:KEYFRAMES]):
        color = np.full((*frame.camera.shape, 3), 50 * (number + 1), np.uint8)
        id = m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, color=color)
        if number < swept:
            m.infer(sweeps=1, keyframes=[id])
    return m


@pytest.mark.parametrize("asked_before", [True, False])
@pytest.mark.parametrize("case", ["settled", "live", "one not swept", "dated"])
def test_while_it_settles_all_that_is_asked_is_of_the_map_at_rest(
    tmp_path: Path, case: str, asked_before: bool
) -> None:
    def build() -> MRFMap:
        m = painted(100.0 if case == "dated" else 0.0, KEYFRAMES - (case == "one not swept"))
        if case == "settled":
            m.infer()
        return m

    m = build()
    at_rest = answers(m if asked_before else build(), tmp_path / "before")
    with FullInference(m, keep_before=True) as inference:
        for number, _ in enumerate(inference):
            if number in (0, KEYFRAMES):
                with inference.showing_before():
                    during = answers(m, tmp_path / f"during {number}")
                assert during.keys() == at_rest.keys()
                for name, values in at_rest.items():
                    np.testing.assert_array_equal(values, during[name], err_msg=name)
    afterwards, twin = answers(m, tmp_path / "after"), build()
    twin.infer()
    for name, values in answers(twin, tmp_path / "twin").items():
        np.testing.assert_array_equal(values, afterwards[name], err_msg=name)


def test_who_looked_at_the_map_before_is_told_what_has_changed_since() -> None:
    m = incremental()
    m.view.pool.take_touched()
    with FullInference(m, keep_before=True) as inference:
        for _ in inference:
            with inference.showing_before():
                m.view.pool.take_touched()
    np.testing.assert_array_equal(m.view.pool.take_touched(), m.view.pool.in_use)


def test_a_rebuilt_map_ends_where_it_is_told_and_stays_stale() -> None:
    m = LogOddsMap(small_room.VOXEL_SIZE)
    first, *_ = [small_room.add(m, frame) for frame in small_room.frames()[: KEYFRAMES + 1]]
    m.remove_keyframe(first)
    inference = settled(m, 1, copy=True, at_once=True)
    assert inference.outcome is not None
    assert not inference.outcome.complete
    assert m.stale
    assert settled(m, 1, copy=False).outcome is not None  # completed: all keyframes are in it
    assert not m.stale
