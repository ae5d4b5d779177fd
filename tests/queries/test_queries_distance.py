"""Distances to the nearest obstacle: against SciPy's transform of the whole box, after any edits."""

from typing import Any

import numpy as np
import pytest
import small_room
from hand_made import PRIOR, VOXEL
from hypothesis import example, given, settings
from hypothesis import strategies as st
from queried_maps import HandMap, hand_map, map_of, room_map
from scipy.ndimage import distance_transform_edt

from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.box import map_extent, read_box
from taichi_mrf.queries.distance import DistanceField
from taichi_mrf.system import memory
from taichi_mrf.voxels.layout import BRICK, VOXELS

RULES = ("free", "occupied", "unknown")
MAX_M = 0.4
LOWER, UPPER = np.array((-1.9, 1.1, -0.9)), np.array((-1.3, 1.6, -0.4))
"""In the middle of the map made by hand."""


@pytest.fixture(scope="module")
def hand(backend: str) -> HandMap:
    return hand_map(backend, occupied=0.002)


def centres(lower: np.ndarray, upper: np.ndarray, voxel_size: float) -> np.ndarray:
    """The centres of a box's voxels, (x, y, z, 3)."""
    cells = np.indices(tuple((upper - lower).tolist())).transpose(1, 2, 3, 0) + lower
    return (cells + 0.5) * voxel_size


def transformed(state: np.ndarray, unknown: str, max_m: float, voxel_size: float) -> np.ndarray:
    """The oracle: distances in a whole box by SciPy, whose border spoils what is within ``max_m`` of it."""
    obstacle = state != 1 if unknown == "occupied" else state == 2
    beyond = np.full(state.shape, np.inf)
    outer = distance_transform_edt(~obstacle) if obstacle.any() else beyond
    inner = distance_transform_edt(obstacle) if not obstacle.all() else beyond
    distance = np.clip(np.where(obstacle, 0.5 - inner, outer - 0.5) * voxel_size, -max_m, max_m)
    return np.where((state == 0) & (unknown == "unknown"), np.nan, distance)


def trimmed(values: np.ndarray, max_m: float = MAX_M, voxel_size: float = VOXEL) -> np.ndarray:
    margin = int(np.ceil(max_m / voxel_size)) + 1
    return values[(slice(margin, -margin),) * 3]


@pytest.fixture(scope="module")
def around_hand(hand: HandMap) -> tuple[np.ndarray, np.ndarray]:
    """The centres of the voxels of a box around the map, and their states by the oracle."""
    points = centres(np.array([-72, -8, -56]), np.array([24, 88, 40]), VOXEL)
    state = hand.true_state(np.floor(points.reshape(-1, 3) / VOXEL).astype(int))
    return points, state.reshape(points.shape[:3])


@pytest.mark.backends
@pytest.mark.parametrize("unknown", RULES)
def test_distances_at_the_centres_are_those_of_scipys_transform(
    hand: HandMap, around_hand: tuple[np.ndarray, np.ndarray], unknown: Any
) -> None:
    points, state = around_hand
    wanted = trimmed(transformed(state, unknown, MAX_M, VOXEL))
    field = DistanceField(hand, MAX_M, unknown)
    found = trimmed(field.distance(points.reshape(-1, 3)).reshape(points.shape[:3]))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)
    assert len(np.unique(wanted[np.isfinite(wanted)].round(6))) > 30
    assert (wanted < 0).any()
    assert np.isnan(wanted).any() == (unknown == "unknown")


@pytest.mark.parametrize("side", [1, 2, 5])
def test_inside_an_obstacle_distances_are_negative_and_zero_lies_on_its_faces(
    backend: str, side: int
) -> None:
    log_odds = np.full((16, 16, 16), -6.0)
    log_odds[5 : 5 + side, 5 : 5 + side, 5 : 5 + side] = 3.0
    field = DistanceField(map_of(backend, (0, 0, 0), log_odds), 0.3)
    middle = (5 + side // 2 + 0.5) * VOXEL
    along = np.full((17, 3), middle)
    along[:, 0] = np.arange(17) * VOXEL  # the planes between voxels
    distance = field.distance(along)
    np.testing.assert_allclose(distance[[5, 5 + side]], 0, atol=1e-7)
    assert (distance[6 : 5 + side] < 0).all()
    assert (distance[:5] > 0).all()
    assert (distance[6 + side :] > 0).all()
    depth = (side - side // 2 - 0.5) * VOXEL
    assert field.distance([[middle] * 3])[0] == pytest.approx(-depth, abs=1e-7)


def test_distances_between_centres_are_off_by_less_than_half_a_voxel(hand: HandMap) -> None:
    points = np.random.default_rng(1).uniform(LOWER, UPPER, (300, 3))
    first = np.floor(LOWER / VOXEL).astype(int) - 12
    voxels = np.indices(tuple(np.ceil((UPPER - LOWER) / VOXEL).astype(int) + 24)).reshape(3, -1).T + first
    obstacles = (voxels[hand.true_state(voxels) == 2] + 0.5) * VOXEL
    nearest = np.array([np.linalg.norm(obstacles - point, axis=1).min() for point in points])
    wanted = np.minimum(nearest - VOXEL / 2, MAX_M)
    off = np.abs(DistanceField(hand, MAX_M).distance(points) - wanted)[
        nearest > VOXEL
    ]  # outside of obstacles
    assert off.max() < 0.5 * VOXEL
    assert off.mean() < 0.1 * VOXEL


@settings(max_examples=25)  # of 20 points each
@given(st.integers(0, 2**32 - 1))
def test_the_gradient_is_that_of_the_distance(hand: HandMap, seed: int) -> None:
    random = np.random.default_rng(seed)
    field = DistanceField(hand, MAX_M)
    # Away from where the interpolation has its kinks: the planes through the voxels' centres.
    cells = random.integers(np.round(LOWER / VOXEL), np.round(UPPER / VOXEL) - 1, (20, 3))
    points = (cells + 0.5 + random.uniform(0.2, 0.8, cells.shape)) * VOXEL
    gradient, step = field.distance_and_gradient(points)[1], 5e-3
    for axis in range(3):
        aside = step * np.eye(3)[axis]
        slope = (field.distance(points + aside) - field.distance(points - aside)) / (2 * step)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-3)


@pytest.mark.parametrize("unknown", RULES)
def test_far_from_all_that_is_known(hand: HandMap, unknown: Any) -> None:
    points = [[30.0, 30.0, 30.0], [-1e30, 30.1, 30.0]]
    distance, gradient = DistanceField(hand, MAX_M, unknown).distance_and_gradient(points)
    wanted = {"free": MAX_M, "occupied": -MAX_M, "unknown": np.nan}[unknown]
    np.testing.assert_array_equal(distance, np.float32(wanted))
    np.testing.assert_array_equal(gradient, np.nan if unknown == "unknown" else 0)
    assert DistanceField(hand, MAX_M, unknown).distance(np.zeros((0, 3))).shape == (0,)


class Edited:
    """A map that tests change brick by brick: its bricks are three along each axis, some of them made."""

    def __init__(self, backend: str) -> None:
        self.map = map_of(backend, (-8, 0, 8), np.full((8, 8, 8), PRIOR))
        self.pool, self.topology = self.map.hand.pool, self.map.hand.topology
        self.slots: dict[tuple[int, int, int], int] = {(-1, 0, 1): int(self.pool.in_use[0])}
        self.crossed: set[tuple[int, int, int]] = set()

    def clear(self) -> None:
        for brick in list(self.slots):
            self.remove(brick)
        for brick in list(self.crossed):
            self.cross(brick)

    def write(self, brick: tuple[int, int, int], log_odds: np.ndarray) -> None:
        where = np.array([brick], np.int32)
        if brick not in self.slots:
            slot = self.pool.allocate(where)
            self.pool.owners[slot] = 1
            self.topology.insert(where, slot)
            self.slots[brick] = int(slot[0])
        self.pool.write("total", np.array([self.slots[brick]], np.int32), log_odds.reshape(1, VOXELS))

    def remove(self, brick: tuple[int, int, int]) -> None:
        if brick in self.slots:
            self.topology.erase(np.array([brick], np.int32))
            self.pool.release(np.array([self.slots.pop(brick)], np.int32))

    def cross(self, brick: tuple[int, int, int]) -> None:
        """Let a ray more cross a brick, or one less."""
        self.topology.add_crossings(np.array([brick], np.int32), -1 if brick in self.crossed else 1)
        self.crossed ^= {brick}

    def edit(self, random: np.random.Generator) -> None:
        """A brick is written, in part or as a whole, goes, or is seen to be free. One is left: seen-free
        bricks are looked for around those with voxels and cameras, and there are no cameras here."""
        x, y, z = np.add(random.integers(-1, 2, 3), (-1, 0, 1)).tolist()
        what = random.integers(5)
        if what == 0 and len(self.slots) > 1:
            self.remove((x, y, z))
        elif what == 1:
            self.cross((x, y, z))
        else:
            share = random.choice([0.003, 0.05, 0.7, 1.0])
            free = np.where(random.random(VOXELS) < random.choice([0.0, 0.5]), PRIOR, -6.0)
            self.write((x, y, z), np.where(random.random(VOXELS) < share, 2.0, free))


@pytest.fixture(scope="module")
def edited(backend: str) -> Edited:
    return Edited(backend)


@pytest.mark.backends
@settings(max_examples=40)  # each makes up to four fields
@example(379829, [1], "free", 0.22)  # points that float64 puts into other voxels from other windows
@example(190558, [1], "occupied", 0.04)  # bricks that are seen to be free, and hardly any others
@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.integers(1, 3), min_size=1, max_size=3),
    st.sampled_from(RULES),
    st.sampled_from([0.04, 0.22, 0.45]),
)
def test_a_field_that_follows_edits_is_the_field_made_anew(
    edited: Edited, seed: int, numbers: list[int], unknown: Any, max_m: float
) -> None:
    random = np.random.default_rng(seed)
    edited.clear()
    edited.write((-1, 0, 1), np.full(VOXELS, PRIOR))
    for _ in range(4):
        edited.edit(random)
    points = centres(np.array([-28, -20, -12]), np.array([20, 28, 36]), VOXEL)
    field, flat = DistanceField(edited.map, max_m, unknown), points.reshape(-1, 3)
    before = field.distance(flat)
    for number in numbers:
        for _ in range(number):
            edited.edit(random)
        counted = field.update()
        now = field.distance(flat)
        anew = DistanceField(edited.map, max_m, unknown)
        np.testing.assert_array_equal(now, anew.distance(flat))
        state = edited.map.state(flat).reshape(points.shape[:3])
        wanted = trimmed(transformed(state, unknown, max_m, VOXEL), max_m)
        found = trimmed(now.reshape(points.shape[:3]), max_m)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7)
        assert counted == (~np.isclose(now, before, rtol=0, atol=1e-5, equal_nan=True)).sum()
        assert field.update() == 0
        before = now


def test_only_what_has_changed_is_worked_out_again(edited: Edited) -> None:
    """Values elsewhere are spoilt on purpose, and stay so."""
    edited.clear()
    wall = np.full((BRICK, BRICK, BRICK), -6.0)
    wall[:, :, 3] = 2.0
    for x in range(-3, 4):
        edited.write((x, 0, 1), wall)
    field = DistanceField(edited.map, 0.2)
    spoilt = field._bricks.values
    spoilt.fill(7.0)
    wall[4, 4, 3] = -6.0
    edited.write((-3, 0, 1), wall)
    assert field.update() > 0
    found = field.distance((np.array([[-20, 4, 11], [26, 4, 11]]) + 0.5) * VOXEL)
    assert found[0] == pytest.approx(0.5 * VOXEL)
    assert found[1] == 7.0


def test_a_field_whose_update_failed_answers_nothing(edited: Edited, monkeypatch: pytest.MonkeyPatch) -> None:
    edited.clear()
    edited.write((0, 0, 0), np.full(VOXELS, 2.0))
    field = DistanceField(edited.map, 0.3)
    edited.write((1, 0, 0), np.full(VOXELS, 2.0))
    with monkeypatch.context() as patch:
        patch.setattr("taichi_mrf.queries.distance_bricks.along_y", None)
        with pytest.raises(TypeError):
            field.update()
    with pytest.raises(ConfigError, match=r"did not end: call update\(\) again"):
        field.distance([[0, 0, 0]])
    field.update()
    points = np.random.default_rng(6).uniform(-0.5, 1.0, (300, 3))
    np.testing.assert_array_equal(field.distance(points), DistanceField(edited.map, 0.3).distance(points))


def test_the_window_grows_with_the_map(edited: Edited) -> None:
    edited.clear()
    block = np.full(VOXELS, 2.0)
    edited.write((0, 0, 0), block)
    field = DistanceField(edited.map, 0.3)
    place = np.array([[-20, 10, 5], [30, -5, 8]])
    for brick in place.tolist():
        edited.write((brick[0], brick[1], brick[2]), block)
    field.update()
    points = (np.concatenate([place, [[0, 0, 0]]]) * BRICK + (-1, 4.5, 4.5)) * VOXEL
    np.testing.assert_allclose(field.distance(points), VOXEL, atol=1e-6)
    edited.clear()
    edited.cross((0, 0, 0))
    assert field.update() > 0
    np.testing.assert_array_equal(field.distance(points), np.float32(0.3))
    assert field.update() == 0


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_fields_of_every_method_are_those_of_their_states(backend: str, method: str) -> None:
    m = room_map(method)
    lower, upper = map_extent(m)
    box = read_box(m, lower - 1.0, upper + 1.0)
    wanted = trimmed(transformed(box.state, "unknown", 0.35, 0.1), 0.35, 0.1)
    points = centres(np.array(box.lowest), np.array(box.lowest) + box.state.shape, 0.1)
    found = DistanceField(m, 0.35, "unknown").distance(points.reshape(-1, 3)).reshape(points.shape[:3])
    np.testing.assert_allclose(trimmed(found, 0.35, 0.1), wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", [MRFMap, LogOddsMap])
def test_a_field_follows_keyframes(backend: str, kind: Any) -> None:
    m = kind(small_room.VOXEL_SIZE)
    field = DistanceField(m, 0.5, "occupied")
    assert field.update() == 0
    points = small_room.probes()
    frames = small_room.frames()[:3]
    ids = [small_room.add(m, frame) for frame in frames]
    m.infer()
    assert field.update() > 0
    moved = frames[1].T_world_camera.copy()
    moved[:3, 3] += 0.3
    for change in (lambda: m.move_keyframe(ids[1], moved), lambda: m.remove_keyframe(ids[0])):
        change()
        m.infer()
        assert field.update() > 0
        anew = DistanceField(m, 0.5, "occupied")
        np.testing.assert_array_equal(field.distance(points), anew.distance(points))


def test_a_field_follows_another_map(hand: HandMap, edited: Edited) -> None:
    edited.clear()
    edited.write((-1, 3, -2), np.full(VOXELS, 2.0))
    field = DistanceField(edited.map, MAX_M, "unknown")
    assert field.update(hand) > 0
    points = np.random.default_rng(7).uniform(LOWER, UPPER, (1000, 3))
    wanted = DistanceField(hand, MAX_M, "unknown").distance(points)
    np.testing.assert_array_equal(field.distance(points), wanted)
    assert field.update() == 0
    with pytest.raises(ConfigError, match=r"voxels of 0\.05 m cannot follow a map with voxels of 0\.1 m"):
        field.update(room_map("mrf"))
    np.testing.assert_array_equal(field.distance(points), wanted)


def test_a_field_of_a_box_is_the_whole_one_in_it(hand: HandMap) -> None:
    points = np.random.default_rng(3).uniform(LOWER, UPPER, (1000, 3))
    whole, part = DistanceField(hand, MAX_M), DistanceField(hand, MAX_M, lower=LOWER, upper=UPPER)
    np.testing.assert_allclose(part.distance(points), whole.distance(points), rtol=0, atol=1e-6)
    assert part.bytes < whole.bytes
    edges = np.array([LOWER, UPPER, LOWER - 0.01, UPPER + 0.01])
    distance, gradient = part.distance_and_gradient(edges)
    np.testing.assert_array_equal(np.isnan(distance), [False, False, True, True])
    np.testing.assert_array_equal(np.isnan(gradient).all(axis=1), [False, False, True, True])


@pytest.mark.parametrize("unknown", RULES)
def test_clearance_is_the_least_of_all_balls(hand: HandMap, unknown: Any) -> None:
    random = np.random.default_rng(4)
    places = random.uniform(LOWER, UPPER, (40, 1, 3)) + random.normal(0, 0.05, (40, 7, 3))
    radii = random.uniform(0.0, 0.3, 7)
    field = DistanceField(hand, MAX_M, unknown)
    distance = field.distance(places.reshape(-1, 3)).reshape(40, 7)
    found = field.clearance(places, radii)
    np.testing.assert_allclose(found, (distance - radii).min(axis=1), rtol=0, atol=1e-6)
    assert np.isnan(found).any() == (unknown == "unknown")
    assert (found < 0).any()
    assert field.clearance(np.zeros((0, 7, 3)), radii).shape == (0,)


def test_points_are_read_as_float32_and_float64(hand: HandMap) -> None:
    points = np.random.default_rng(5).uniform(LOWER, UPPER, (200, 3)).astype(np.float32)
    field = DistanceField(hand, MAX_M)
    found = field.distance(points)
    np.testing.assert_allclose(found, field.distance(points.astype(np.float64)), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(found, field.distance(np.repeat(points, 2, axis=0)[::2]))
    np.testing.assert_array_equal(field.distance([[0, 0, 0]]), field.distance(np.zeros((1, 3), np.float32)))


def test_what_cannot_be_worked_out(hand: HandMap, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="max_distance_m must be more than 0"):
        DistanceField(hand, 0.0)
    with pytest.raises(ConfigError, match=r"at most 1024 voxels, 51\.2 m, not 60"):
        DistanceField(hand, 60.0)
    with pytest.raises(ConfigError, match="free, occupied or unknown, not 'stop'"):
        DistanceField(hand, MAX_M, "stop")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="both corners"):
        DistanceField(hand, MAX_M, lower=LOWER)
    with pytest.raises(ConfigError, match="lower < upper"):
        DistanceField(hand, MAX_M, lower=UPPER, upper=LOWER)
    field = DistanceField(hand, MAX_M)
    with pytest.raises(ConfigError, match=r"shape \(N, 3\), not \(3,\)"):
        field.distance(LOWER)
    with pytest.raises(ConfigError, match="not finite"):
        field.distance_and_gradient([[np.nan, 0, 0]])
    with pytest.raises(ConfigError, match=r"shape \(C, S, 3\), not \(2, 3\)"):
        field.clearance(np.zeros((2, 3)), [0.1])
    with pytest.raises(ConfigError, match=r"radii_m \(S,\), one or more, not \(2, 4, 3\) and \(3,\)"):
        field.clearance(np.zeros((2, 4, 3)), [0.1] * 3)
    with pytest.raises(ConfigError, match=r"less than max_distance_m, 0\.4 m"):
        field.clearance(np.zeros((2, 1, 3)), [0.4])
    with monkeypatch.context() as patch:
        patch.setattr("taichi_mrf.queries.distance_bricks._MOST_BRICKS", 10)
        with pytest.raises(CapacityError, match=r"bricks of 8\^3 voxels, but at most 10 are possible"):
            DistanceField(hand, MAX_M)
    monkeypatch.setattr(memory, "_allowance", memory._Allowance())
    monkeypatch.setattr(memory, "available_bytes", lambda: 10_000)
    with pytest.raises(CapacityError, match="distances in"):
        DistanceField(hand, MAX_M)
