"""The map is a function of its set of keyframes, whatever happened before."""

from pathlib import Path

import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import KeyframeError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.layout import BRICK

pytestmark = pytest.mark.usefixtures("backend")


def assert_same_map(a: MRFMap, b: MRFMap) -> None:
    """At least 99.9% of the voxels of either map within 0.01 of probability, and the same bricks."""
    (centres, p), (others, _) = a.voxels(0.0), b.voxels(0.0)
    assert len(centres) == len(others) > 0
    assert (np.abs(b.occupancy(centres) - p) <= 0.01).mean() >= 0.999
    probes = small_room.probes()
    assert (a.state(probes) == b.state(probes)).mean() >= 0.999


WALL_CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)

steps = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "move", "infer", "infer one"]), st.integers(0, 9)),
    max_size=12,
)


def test_frames_that_differ_in_their_stamps_alone_may_come_in_any_order() -> None:
    """With a half-life the order in time counts: something is there between two views of the same wall."""
    wall = np.full(WALL_CAMERA.shape, 3.02, np.float32)
    frames = [(wall, 0.0), (wall, 300.0), (np.minimum(wall, 1.5), 310.0), (wall, 320.0)]
    maps = [MRFMap(0.05, time=TimeConfig(half_life_s=100.0)) for _ in range(2)]
    for m, order in zip(maps, (frames, frames[::-1]), strict=True):
        for depth_m, stamp_s in order:
            m.add_keyframe(depth_m, np.eye(4), WALL_CAMERA, stamp_s=stamp_s)
        m.infer()
    (centres, p), (_, other) = (m.voxels(0.0) for m in maps)
    np.testing.assert_array_equal(p, other)
    np.testing.assert_array_equal(maps[0].state(centres), maps[1].state(centres))


@settings(max_examples=12)
@given(history=steps, final=st.permutations(range(10)).map(lambda order: order[:3]))
def test_any_history_ends_in_the_map_of_the_final_set(
    history: list[tuple[str, int]], final: list[int]
) -> None:
    room = small_room.frames()
    m = MRFMap(small_room.VOXEL_SIZE)
    present: dict[int, int] = {}
    for verb, number in history:
        ids = list(present)
        if verb == "add" and len(ids) < 5:
            present[small_room.add(m, room[number])] = number
        elif verb == "remove" and ids:
            m.remove_keyframe(ids[number % len(ids)])
            del present[ids[number % len(ids)]]
        elif verb == "move" and ids:
            m.move_keyframe(ids[number % len(ids)], room[(number + 3) % 10].T_world_camera)
            present[ids[number % len(ids)]] = -1
        elif verb == "infer":
            m.infer(sweeps=1)
        elif verb == "infer one" and ids:
            m.infer(sweeps=1, keyframes=[ids[number % len(ids)]])
    for id, number in present.items():
        if number in final:  # keep it
            final = [i for i in final if i != number]
            present[id] = number
        else:
            m.remove_keyframe(id)
    kept = [k.name for k in m.keyframes.values()]
    for number in final:
        small_room.add(m, room[number])
    m.infer()
    names = [frame.name for frame in room]
    assert_same_map(m, small_room.build([names.index(name) for name in kept] + final))


ROTATIONS = [np.linalg.matrix_power([[0, -1, 0], [1, 0, 0], [0, 0, 1]], turns) for turns in range(4)]
ROTATIONS += [np.roll(np.eye(3), axes, axis=0) for axes in (1, 2)]
"""Quarter turns around z, and those that exchange all axes."""


@pytest.mark.parametrize("time", [TimeConfig(), TimeConfig(half_life_s=600.0)])
@settings(max_examples=3)
@given(bricks=st.tuples(*[st.integers(-40, 40)] * 3), R=st.sampled_from(ROTATIONS))
def test_a_map_moves_rigidly_with_its_keyframes(
    time: TimeConfig, bricks: tuple[int, int, int], R: np.ndarray
) -> None:
    """By rotations and whole bricks, which take voxels to voxels."""
    here, there = (MRFMap(small_room.VOXEL_SIZE, time=time) for _ in range(2))
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array(bricks) * BRICK * small_room.VOXEL_SIZE
    for frame in small_room.frames()[:2]:
        small_room.add(here, frame)
        id = small_room.add(there, frame)
        there.move_keyframe(id, T @ frame.T_world_camera)
    for m in (here, there):
        m.infer(keyframes=list(m.keyframes))  # in the same order: the canonical one follows from the poses
    centres, p = here.voxels(0.0)
    moved = np.abs(there.occupancy(centres @ T[:3, :3].T + T[:3, 3]) - p)
    assert len(there.voxels(0.0)[0]) == len(p)
    # Rounding takes surfaces on a face between two voxels to either of them.
    assert (moved <= 0.01).mean() >= 0.99
    assert moved.max() < 0.2


def test_adding_and_removing_gives_back_the_map() -> None:
    m = small_room.build([0, 1, 2])
    probes = small_room.probes()
    before, states, size = m.marginals.occupancy(probes), m.state(probes), m.statistics()
    k = small_room.add(m, small_room.frames()[5])
    m.infer(sweeps=2, keyframes=[k])
    assert np.abs(m.marginals.occupancy(probes) - before).max() > 0.5
    m.remove_keyframe(k)
    np.testing.assert_allclose(m.marginals.occupancy(probes), before, atol=1e-5)
    np.testing.assert_array_equal(m.state(probes), states)
    assert m.statistics().bricks == size.bricks


def resident_mb() -> float:
    """Memory that this process holds now: its peak may be that of another test."""
    status = Path("/proc/self/status")
    if not status.exists():
        pytest.skip("only Linux tells how much memory a process holds now")
    return next(
        int(line.split()[1]) * 1024 / 1e6
        for line in status.read_text(encoding="ascii").splitlines()
        if line.startswith("VmRSS:")
    )


def test_adding_and_removing_again_and_again_takes_no_memory() -> None:
    m = small_room.build([0, 1])
    frame = small_room.frames()[2]

    def once() -> float:
        k = small_room.add(m, frame)
        m.infer(sweeps=1, keyframes=[k])
        held_mb = (m.keyframes[k].image_bytes + m.keyframes[k].voxel_bytes) / 1e6
        m.remove_keyframe(k)
        return held_mb

    for _ in range(20):
        keyframe_mb = once()
    size = m.statistics()
    before_mb = resident_mb()
    for _ in range(60):
        once()
    assert m.statistics() == size
    # What one lost keyframe in ten would hold; had one in five been lost, it would show.
    assert resident_mb() - before_mb < 6 * keyframe_mb


def test_freezing_keeps_the_map_and_forgets_the_image() -> None:
    m = small_room.build([0, 1, 2])
    probes = small_room.probes()
    before, states = m.marginals.occupancy(probes), m.state(probes)
    (first, *others) = m.keyframes
    m.freeze_keyframe(first)
    np.testing.assert_array_equal(m.marginals.occupancy(probes), before)
    np.testing.assert_array_equal(m.state(probes), states)
    assert first not in m.keyframes
    assert first in m.frozen
    m.infer()
    assert (np.abs(m.marginals.occupancy(probes) - before) <= 0.01).mean() >= 0.999
    with pytest.raises(KeyframeError, match="frozen"):
        m.remove_keyframe(first)
    for k in others:  # bricks that only the frozen keyframe wants stay
        m.remove_keyframe(k)
    assert (m.state(probes) != UNKNOWN).sum() > 0.2 * (states != UNKNOWN).sum()


def test_freezing_needs_messages() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    k = small_room.add(m, small_room.frames()[0])
    with pytest.raises(KeyframeError, match="infer"):
        m.freeze_keyframe(k)


def test_the_room_is_what_it_is() -> None:
    """Walls and furniture come out occupied, the air between camera and wall free, behind walls unknown."""
    dataset = open_dataset("synthetic:room?width=160&height=120&frames=10")
    m = small_room.build(list(range(10)))
    distance = dataset.signed_distance(small_room.probes())  # type: ignore[attr-defined]
    state = m.state(small_room.probes())
    surface = (np.abs(distance) < 0.25 * small_room.VOXEL_SIZE) & measured(small_room.probes())
    air = distance > 2 * small_room.VOXEL_SIZE
    inside = distance < -2 * small_room.VOXEL_SIZE
    assert (state[air] == OCCUPIED).mean() < 0.002
    assert (state[inside] == FREE).mean() < 0.01
    occupied = state == OCCUPIED
    assert (np.abs(distance[occupied]) < 1.5 * small_room.VOXEL_SIZE).mean() > 0.99
    assert surface.sum() > 500
    assert (state[surface] == OCCUPIED).mean() > 0.9


def measured(points: np.ndarray) -> np.ndarray:
    """Points that at least three frames have measured, to within half a voxel along the optical axis."""
    times = np.zeros(len(points), int)
    for frame in small_room.frames():
        R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
        x, y, z = ((points - t) @ R).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.rint(frame.camera.fx * x / z + frame.camera.cx)
            v = np.rint(frame.camera.fy * y / z + frame.camera.cy)
        seen = (z > 0.1) & (u >= 0) & (v >= 0) & (u < frame.camera.width) & (v < frame.camera.height)
        depth = frame.depth_m[v[seen].astype(int), u[seen].astype(int)]
        times[np.flatnonzero(seen)[np.abs(depth - z[seen]) < 0.5 * small_room.VOXEL_SIZE]] += 1
    return times >= 3


def flat_wall(camera: PinholeCamera, distance: float) -> np.ndarray:
    return np.full(camera.shape, distance, np.float32)


def test_an_outlier_does_not_veto() -> None:
    """One wild pixel in one keyframe does not punch a hole into a wall that others have seen."""
    camera = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)
    m = MRFMap(0.05, PolynomialNoise((0.01,)))
    for i in range(4):
        depth = flat_wall(camera, 2.02)
        if i == 3:
            depth[15, 20] = 5.0
        m.add_keyframe(depth, np.eye(4), camera)
    m.infer()
    assert m.occupancy([[0.0253, 0.0253, 2.02]])[0] > 0.9


def test_a_map_without_measurements_is_unknown() -> None:
    camera = PinholeCamera(8, 6, 10.0, 10.0, 3.5, 2.5)
    m = MRFMap(0.1, surface_density=2.1)
    m.add_keyframe(np.full(camera.shape, np.nan, np.float32), np.eye(4), camera)
    report = m.infer()
    assert report.rays == 0
    assert m.state([[0.0, 0.0, 1.0]])[0] == UNKNOWN
    assert m.occupancy([[0.0, 0.0, 1.0]])[0] == pytest.approx(m.prior) == pytest.approx(-np.expm1(-2.1 * 0.1))
    assert len(m.voxels(0.0)[0]) == 0
    assert np.isnan(m.render_depth(camera, np.eye(4))).all()


def test_stopping_inference_keeps_a_valid_map() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for frame in small_room.frames()[:3]:
        small_room.add(m, frame)
    report = m.infer(progress=lambda at: at.keyframe < 2)
    assert not report.complete
    assert np.isfinite(m.occupancy(small_room.probes())).all()
    m.infer()
    assert_same_map(m, small_room.build([0, 1, 2]))


def test_a_sweep_that_is_skipped_would_have_changed_nothing() -> None:
    m = small_room.build([0, 1])
    k = small_room.add(m, small_room.frames()[2])
    m.infer(sweeps=3, keyframes=[k])
    before, revision = m.occupancy(small_room.probes()), m.keyframes[k].revision
    m.infer(sweeps=1, keyframes=[k])
    assert m.keyframes[k].revision == revision  # it was skipped
    m.keyframes[k].revision = -1  # now it cannot be
    m.infer(sweeps=1, keyframes=[k])
    assert m.keyframes[k].revision > revision
    # Taking a message out of a belief rounds, which may move the new one by its last float16 digit.
    np.testing.assert_allclose(m.occupancy(small_room.probes()), before, atol=1e-3)


def test_a_sweep_is_made_again_when_others_have_spoken() -> None:
    m = small_room.build([0, 1])
    first, second = m.keyframes
    m.infer(sweeps=1, keyframes=[first])
    revision = m.keyframes[first].revision
    m.infer(sweeps=1, keyframes=[second, first])
    assert m.keyframes[first].revision > revision


def test_bundled_rays_give_nearly_the_same_map() -> None:
    room = small_room.frames()[:3]
    every, some = (MRFMap(small_room.VOXEL_SIZE, ray_density=wanted) for wanted in (0.0, 0.5))
    for m in (every, some):
        for frame in room:
            small_room.add(m, frame)
        m.infer()
    centres, p = every.voxels(0.0)
    assert 0 < (np.abs(some.occupancy(centres) - p) > 0.25).mean() < 0.1


def test_tolerance_stops_early() -> None:
    m = small_room.build([0, 1, 2])
    report = m.infer(sweeps=50, tolerance=0.01)
    assert report.sweeps < 10
    assert report.residual <= 0.01
