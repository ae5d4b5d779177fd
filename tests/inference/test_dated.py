"""Evidence with a date: the channel through time, the fold over keyframes, maps of a world that changes."""

import math
from pathlib import Path

import numpy as np
import pytest
import small_room
from ball_room import BALL, TIME, in_turn, near_ball, views
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.inference.dated import in_time
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.types import F32, F32Array
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import faded

STEP_S = 4.0
"""Seconds between the frames of the tests."""


def through_time(
    evidence: NDArray[np.float64], seconds: float, time: TimeConfig = TIME
) -> NDArray[np.float64]:
    """The oracle: what evidence is worth some seconds later, by Bayes' rule on the two states."""
    forgotten = TIME.forgotten(seconds)
    left, appeared = TIME.moving_share * forgotten, (1 - TIME.moving_share) * forgotten
    ratio = np.exp(evidence)
    return np.log(((1 - appeared) * ratio + appeared) / ((1 - left) + left * ratio))


@kernel
def fade_all(evidence: F32Array, kept: F32, left: F32, appeared: F32) -> None:
    for i in range(evidence.shape[0]):
        evidence[i] = faded(evidence[i], kept, left, appeared)


def dated_room(order: list[int], time: TimeConfig | None = TIME) -> MRFMap:
    """A map of some frames of the small room, STEP_S apart by their numbers, fully inferred."""
    m = MRFMap(small_room.VOXEL_SIZE, time=time)
    for i in order:
        add(m, i)
    m.infer()
    return m


def add(m: MRFMap, i: int) -> int:
    frame = small_room.frames()[i]
    return m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name, STEP_S * i)


def beliefs(m: MRFMap) -> dict[tuple[int, int, int], NDArray[np.float32]]:
    """The log-odds that queries read, by brick."""
    pool = m.view.pool
    slots = pool.in_order
    return dict(zip(map(tuple, pool.bricks[slots].tolist()), pool.read("belief", slots), strict=True))


def assert_equal_bits(a: MRFMap, b: MRFMap) -> None:
    ours, theirs = beliefs(a), beliefs(b)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[brick], theirs[brick]) for brick in ours)


def test_the_rate_follows_from_the_half_life() -> None:
    assert TIME.forgotten(600.0) == pytest.approx(0.5)
    assert TIME.flip_rate == pytest.approx(math.log(2) / 1200)
    assert TimeConfig().is_static
    assert TimeConfig().forgotten(1e9) == 0
    for field in ("half_life_s", "moving_share", "glimpse_half_life_s"):
        with pytest.raises(ConfigError, match=field):
            TimeConfig(**{field: -1.0})


@pytest.mark.backends
@pytest.mark.usefixtures("backend")
def test_the_channel_is_that_of_the_oracle() -> None:
    evidence = np.linspace(-60, 60, 241)
    for seconds in (0.0, 0.3, 60.0, 1e4, 1e7):
        forgotten = TIME.forgotten(seconds)
        left, appeared = TIME.moving_share * forgotten, (1 - TIME.moving_share) * forgotten
        found = evidence.astype(np.float32)
        fade_all(found, 1 - forgotten, left, appeared)
        np.testing.assert_allclose(found, through_time(evidence, seconds), atol=2e-4, rtol=1e-5)


@given(st.floats(-30, 30), st.floats(0, 1e4), st.floats(0, 1e4))
def test_time_in_two_steps_is_time_in_one(evidence: float, first: float, second: float) -> None:
    at_once = through_time(np.array(evidence), first + second)
    in_steps = through_time(through_time(np.array(evidence), first), second)
    assert in_steps == pytest.approx(at_once, abs=1e-6)


@pytest.mark.backends
@pytest.mark.usefixtures("backend")
def test_beliefs_are_the_fold_of_the_messages() -> None:
    m = dated_room([0, 3, 1, 2])
    pool, prior = m.view.pool, m.view.pool.prior_log_odds
    expected = np.full((pool.capacity, VOXELS), prior)
    last = np.full(pool.capacity, -np.inf)
    for keyframe in in_time(m.keyframes.values()):
        assert keyframe.messages is not None
        messages = keyframe.messages.to_numpy().reshape(-1, VOXELS)
        for row, slot in enumerate(keyframe.visible.slots.tolist()):
            seconds = 0.0 if last[slot] == -np.inf else keyframe.stamp_s - last[slot]
            evidence = through_time(expected[slot] - prior, seconds)
            expected[slot] = prior + evidence + messages[row]
            last[slot] = keyframe.stamp_s
    seen = last == m.now_s
    slots = np.flatnonzero(seen & (pool.owners > 0)).astype(np.int32)
    assert len(slots) > 50
    shown = pool.read("belief", slots)
    glimpsed = shown > expected[slots] + 1.0
    assert glimpsed.mean() < 0.01
    np.testing.assert_allclose(shown[~glimpsed], expected[slots][~glimpsed], atol=0.02)


@pytest.mark.usefixtures("backend")
def test_stamps_do_not_matter_in_a_static_world() -> None:
    with_stamps = dated_room([0, 1, 2], None)
    assert_equal_bits(with_stamps, small_room.build([0, 1, 2]))
    for verb in (lambda: with_stamps.at(1.0), lambda: with_stamps.dynamic, lambda: with_stamps.static):
        with pytest.raises(ConfigError, match="half_life_s"):
            verb()


steps = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "move", "infer", "renew", "look"]), st.integers(0, 4)),
    max_size=8,
)


@pytest.mark.usefixtures("backend")
@settings(max_examples=6)
@given(steps)
def test_any_history_of_dated_keyframes_ends_in_the_same_map(history: list[tuple[str, int]]) -> None:
    frames = small_room.frames()
    m = MRFMap(small_room.VOXEL_SIZE, time=TIME)
    present: dict[int, int] = {}
    for verb, number in history:
        ids = [id for i, id in present.items() if i == number]
        if verb == "add" and not ids:
            present[number] = add(m, number)
        elif verb == "remove" and ids:
            m.remove_keyframe(present.pop(number))
        elif verb == "move" and ids:
            m.move_keyframe(ids[0], frames[number + 1].T_world_camera)
        elif verb == "infer":
            m.infer(sweeps=1)
        elif verb == "renew":
            m.renew(ids)
        elif verb == "look":
            m.occupancy(small_room.probes()[:1000])
    for number in (2, 0, 1):
        if number not in present:
            present[number] = add(m, number)
        else:
            m.move_keyframe(present[number], frames[number].T_world_camera)
    for number in present.keys() - {0, 1, 2}:
        m.remove_keyframe(present[number])
    m.infer()
    assert_equal_bits(m, dated_room([0, 1, 2]))


@pytest.mark.usefixtures("backend")
def test_the_map_of_another_time_holds_the_keyframes_up_to_then() -> None:
    m = dated_room([0, 1, 2, 3])
    assert m.now_s == 3 * STEP_S
    centres, p = m.marginals.voxels(0.0)
    np.testing.assert_allclose(m.at(m.now_s).occupancy(centres), p, atol=0.01)
    first = m.at(0.0)
    by_first = m.keyframes[0]
    pool = m.view.pool
    unseen = np.setdiff1d(pool.in_use, by_first.visible.slots)
    assert len(unseen)
    assert (first.view.pool.read("belief", unseen) == pool.prior_log_odds).all()
    assert len(m.at(-1.0).voxels(0.5)[0]) == 0
    assert len(first.marginals.voxels(0.5)[0]) > 100
    m.remove_keyframe(0)
    with pytest.raises(KeyframeError, match="has changed"):
        first.marginals.occupancy(centres)


@pytest.mark.usefixtures("backend")
def test_frozen_evidence_passes_through_time_as_a_whole() -> None:
    kept = dated_room([0, 1, 2])
    frozen = dated_room([0, 1, 2])
    for id in (0, 1):
        frozen.freeze_keyframe(id)
    assert_equal_bits(frozen, kept)
    later = [add(m, 5) for m in (kept, frozen)]
    for m, id in zip((kept, frozen), later, strict=True):
        m.infer(keyframes=[id], sweeps=1)
    ours, theirs = beliefs(frozen), beliefs(kept)
    assert np.mean([np.abs(ours[b] - theirs[b]).mean() for b in ours]) < 0.05


ORDERS = [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1), (1, 3), (3,)]


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("order", ORDERS)
def test_keyframes_may_be_frozen_in_any_order(order: tuple[int, ...]) -> None:
    kept, m = dated_room([0, 1, 2, 3]), dated_room([0, 1, 2, 3])
    now_s = m.now_s
    for id in order:
        m.freeze_keyframe(id)
        assert_equal_bits(m, kept)
    assert m.now_s == now_s
    assert m._parts.dated is not None
    assert (m._parts.dated.waiting_bytes > 0) == (order in ((1, 3), (3,)))
    for id in set(range(4)) - set(order):
        m.freeze_keyframe(id)
    assert_equal_bits(m, kept)
    assert m._parts.dated.waiting_bytes == 0


@pytest.mark.usefixtures("backend")
def test_what_waits_for_a_keyframe_goes_on_when_it_is_removed_or_moved() -> None:
    kept, m = dated_room([0, 1, 2, 3]), dated_room([0, 1, 2, 3])
    m.freeze_keyframe(3)
    m.freeze_keyframe(2)
    for each in (kept, m):
        each.move_keyframe(1, small_room.frames()[1].T_world_camera)
        each.remove_keyframe(0)
    assert_equal_bits(m, kept)
    for each in (kept, m):
        each.remove_keyframe(1)
    assert_equal_bits(m, kept)
    assert m._parts.dated is not None
    assert m._parts.dated.waiting_bytes == 0


@pytest.mark.usefixtures("backend")
def test_files_keep_what_waits(tmp_path: Path) -> None:
    kept, m = dated_room([0, 1, 2, 3]), dated_room([0, 1, 2, 3])
    for id in (3, 1):
        m.freeze_keyframe(id)
    m.save(tmp_path / "map.npz")
    # Earlier versions would pass over the messages that wait: they refuse the file.
    assert format_of(tmp_path / "map.npz") == 4
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert_equal_bits(loaded, m)
    assert_equal_bits(loaded, kept)
    for each in (m, loaded):
        each.infer()
    assert_equal_bits(loaded, m)
    for each in (m, loaded):
        for id in (2, 0):
            each.freeze_keyframe(id)
    assert_equal_bits(loaded, m)
    m.save(tmp_path / "map.npz")
    assert format_of(tmp_path / "map.npz") == 2


def format_of(path: Path) -> int:
    with np.load(path) as file:
        return int(file["format"])


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("read_between", [False, True])
def test_late_keyframes_may_be_frozen_in_any_order(read_between: bool) -> None:
    """Two that are older than all that was frozen, with queries between the steps or without."""
    found = []
    for order in ((0, 1), (1, 0)):
        m = dated_room([2, 3])
        for id in (0, 1):
            m.freeze_keyframe(id)
        late = []
        for i in (0, 1):
            late.append(add(m, i))
            if read_between:
                m.decided.occupancy(np.zeros((1, 3)))
        m.infer()
        for k in order:
            m.freeze_keyframe(late[k])
            if read_between:
                beliefs(m)
        found.append(m)
    assert_equal_bits(*found)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("then_frozen", [False, True])
def test_a_keyframe_that_comes_after_newer_ones_were_folded_counts_as_of_its_stamp(then_frozen: bool) -> None:
    """Oracle: the late ones by themselves, through time up to the newer ones, and added to these."""
    m = dated_room([3, 4])
    pool, prior = m.view.pool, m.view.pool.prior_log_odds
    newer = {brick: values.astype(np.float64) for brick, values in beliefs(m).items()}
    for id in (0, 1):
        m.freeze_keyframe(id)
    late = [add(m, 0), add(m, 1)]
    m.infer(keyframes=late, sweeps=1)
    expected = {}
    chain = {brick: np.zeros(VOXELS) for brick in newer}
    stamps: dict[tuple[int, ...], float] = {}
    for keyframe in (m.keyframes[id] for id in late):
        assert keyframe.messages is not None
        rows = keyframe.messages.to_numpy().reshape(-1, VOXELS)
        for row, brick in enumerate(map(tuple, pool.bricks[keyframe.visible.slots].tolist())):
            if brick in newer:
                gone_s = keyframe.stamp_s - stamps.get(brick, keyframe.stamp_s)
                chain[brick] = through_time(chain[brick], gone_s) + rows[row]
                stamps[brick] = keyframe.stamp_s
    if then_frozen:
        for id in late[::-1]:
            m.freeze_keyframe(id)
    assert m._parts.dated is not None
    assert m._parts.dated.frozen is not None
    folded = dict(zip(map(tuple, pool.bricks.tolist()), m._parts.dated.frozen.stamp_s, strict=False))
    found = beliefs(m)
    for brick, stamp_s in stamps.items():
        if folded[brick] == m.now_s == 4 * STEP_S:
            expected[brick] = newer[brick] + through_time(chain[brick], m.now_s - stamp_s)
    assert len(expected) > 20
    differ = np.stack([np.abs(found[brick] - values) for brick, values in expected.items()])
    assert np.quantile(differ, 0.99) < 0.02  # a glimpse is the rest
    assert (np.abs(np.stack([expected[b] - newer[b] for b in expected])) > 0.5).mean() > 0.01
    assert prior < 0


@pytest.mark.usefixtures("one_backend")
def test_of_too_many_dated_keyframes_the_oldest_are_frozen() -> None:
    m = dated_room([4, 0, 3, 1])
    assert surplus(m, 0, 2) == [1, 3]
    static = dated_room([4, 0, 3, 1], None)
    assert sorted(surplus(static, 0, 1)) == [1, 2, 3]


@pytest.mark.usefixtures("backend")
def test_a_dated_map_keeps_its_stamps_and_beliefs_in_its_file(tmp_path: Path) -> None:
    m = dated_room([0, 1, 2])
    m.freeze_keyframe(0)
    m.infer()
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert_equal_bits(loaded, m)
    assert loaded.config.time == TIME
    assert {k.stamp_s for k in loaded.keyframes.values()} == {STEP_S, 2 * STEP_S}
    loaded.infer()
    assert_equal_bits(loaded, m)


def ball_voxels(m: MRFMap) -> int:
    centres, _ = m.voxels(0.5)
    distance = np.linalg.norm(centres - np.array(BALL.center), axis=1)
    return int((np.abs(distance - 0.25) < 1.5 * small_room.VOXEL_SIZE).sum())


@pytest.mark.usefixtures("one_backend")
def test_a_newcomer_shows_where_many_views_saw_nothing() -> None:
    everywhere = list(range(10))
    before, after = views(everywhere * 2, ball=False), views(everywhere, ball=True)
    seeing = [view for view, old in zip(after, before, strict=False) if (view[0] != old[0]).sum() > 200]
    assert len(seeing) >= 3
    alone, static, dated = (MRFMap(small_room.VOXEL_SIZE, time=time) for time in (None, None, TIME))
    in_turn(alone, seeing[:3])
    for m in (static, dated):
        in_turn(m, before + seeing[:3])
    for m in (alone, static, dated):
        m.infer()
    assert ball_voxels(static) < 0.25 * ball_voxels(alone)
    assert ball_voxels(dated) > 0.5 * ball_voxels(alone)
    layer = dated.dynamic
    centres, _ = layer.voxels(0.5)
    assert near_ball(centres).mean() > 0.5
    assert not len(np.intersect1d(dated.static.voxels(0.5)[0].view("f8,f8,f8"), centres.view("f8,f8,f8")))


@pytest.mark.usefixtures("one_backend")
def test_a_single_view_is_shown_at_once_and_forgotten_soon() -> None:
    everywhere = list(range(10))
    before, after = views(everywhere * 2, ball=False), views(everywhere, ball=True)
    most = max(everywhere, key=lambda i: int((before[i][0] != after[i][0]).sum()))
    m = MRFMap(small_room.VOXEL_SIZE, time=TIME)
    in_turn(m, [*before, after[most]])
    m.infer()
    seen, now = ball_voxels(m), m.now_s
    assert seen > 10
    assert ball_voxels(m.at(now + 60.0)) < 0.2 * seen  # type: ignore[arg-type]


@pytest.mark.usefixtures("one_backend")
def test_log_odds_fade_between_scans() -> None:
    frame = small_room.frames()[0]
    faded_map, plain = (LogOddsMap(small_room.VOXEL_SIZE, time=time) for time in (TimeConfig(10.0), None))
    for m in (faded_map, plain):
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, stamp_s=0.0)
    other = small_room.frames()[5]
    nothing = np.zeros_like(other.depth_m)
    for m in (faded_map, plain):
        m.add_keyframe(nothing, other.T_world_camera, other.camera, stamp_s=10.0)
    centres, p = plain.voxels(0.0)
    # Half of the state is drawn anew in one half-life.
    np.testing.assert_allclose(faded_map.occupancy(centres), 0.5 + 0.5 * (p - 0.5), atol=1e-4)


@pytest.mark.usefixtures("one_backend")
def test_glimpses_are_counted_and_end() -> None:
    m = dated_room([0, 1, 2, 3, 4])
    dated = m._parts.dated
    assert dated is not None
    pool = m.view.pool
    pool.read("belief", pool.in_use)
    channels = dated._channels
    differs = (channels.shown.to_numpy() > channels.now.to_numpy()).reshape(-1, VOXELS).sum(axis=1)
    assert differs.sum() > 0
    np.testing.assert_array_equal(channels.glimpsed.to_numpy()[: pool.capacity], differs[: pool.capacity])
    far = np.zeros_like(small_room.frames()[9].depth_m)
    for later in range(1, 12):  # an image without a measurement lets time pass
        frame = small_room.frames()[9]
        m.add_keyframe(far, frame.T_world_camera, frame.camera, stamp_s=m.now_s + 10.0 * later)
        pool.read("belief", pool.in_use)
    assert channels.glimpsed.to_numpy().max() == 0
