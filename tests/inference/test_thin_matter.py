"""Things that are thinner than a voxel: rays that end on them are few, and others outvote them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf import MRFMap, PinholeCamera, PolynomialNoise, load_map
from taichi_mrf.config.sections import LIVE_HALF_LIFE_S, TimeConfig
from taichi_mrf.inference.thin_matter import call_matter
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.npz_file import MANIFEST, manifest_lines

CAMERA = PinholeCamera(96, 72, 80.0, 80.0, 47.5, 35.5)
VOXEL, WALL_M, POST_M, RADIUS_M = 0.05, 2.02, 1.02, 0.012
POST_X_M = 0.02
STEPS_M = np.linspace(-0.4, 0.4, 10)
NOISE = PolynomialNoise(sigma=(0.004,))


def depth_image(x_m: float, with_post: bool = True, post_m: float = POST_M) -> NDArray[np.float32]:
    """What a camera at (x, 0, 0) that looks along z sees: a wall, and an upright post in front of it."""
    u, _ = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    slope = (u - CAMERA.cx) / CAMERA.fx
    at_post_m = x_m + slope * post_m
    on_post = with_post & (np.abs(at_post_m - POST_X_M) < RADIUS_M)
    return np.where(on_post, post_m, WALL_M).astype(np.float32)


def pose(x_m: float) -> NDArray[np.float64]:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x_m
    return T_world_camera


def mapped(posts: NDArray[np.bool_], noise: PolynomialNoise = NOISE, **parameters: object) -> MRFMap:
    """A map of keyframes, in some of which the post is there."""
    m = MRFMap(VOXEL, noise, **parameters)
    for i, (x_m, there) in enumerate(zip(STEPS_M, posts, strict=True)):
        m.add_keyframe(depth_image(x_m, bool(there)), pose(x_m), CAMERA, f"{i}", float(i))
    return m


def post_points() -> NDArray[np.float64]:
    heights_m = np.arange(-0.2, 0.2, VOXEL) + 0.02
    return np.stack([np.full_like(heights_m, POST_X_M), heights_m, np.full_like(heights_m, POST_M)], axis=1)


ALWAYS = np.ones(len(STEPS_M), bool)


@pytest.mark.compilers
@pytest.mark.usefixtures("backend")
def test_a_post_thinner_than_a_voxel_is_occupied_and_in_the_way() -> None:
    m = mapped(ALWAYS)
    m.infer()
    assert (
        m.marginals.occupancy(post_points()) < 0.05
    ).all()  # the rays that pass beside it outvote those that end
    assert (m.state(post_points()) == OCCUPIED).all()
    beside = np.add(post_points(), (0.1, 0.0, 0.0))
    assert (m.state(beside) == FREE).all()
    way = np.array([[POST_X_M, 0.0, 0.7], [POST_X_M, 0.0, 1.3]])
    assert m.path_collision(way, 0.1) > 0.95
    assert m.path_collision(np.add(way, (0.25, 0.0, 0.0)), 0.1) < 0.05
    hits = m.decided.render_depth(CAMERA, pose(0.0))
    assert abs(float(hits[36, 49]) - POST_M) < 1.5 * VOXEL


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("first", [0, 4, 8])
def test_what_was_there_in_two_of_ten_keyframes_is_not_occupied(first: int) -> None:
    there = ~ALWAYS
    there[first : first + 2] = True
    m = mapped(there)
    m.infer()
    assert not (m.state(post_points()) == OCCUPIED).any()


def scores_of(m: MRFMap, voxels: NDArray[np.int64]) -> NDArray[np.int32]:
    """The scores of voxels (n, 3), brought up to date by a query."""
    m.state([[0.0, 0.0, 0.0]])
    scores = m._parts.decisions._votes.to_numpy().reshape(-1, 512, 2)[..., 1]
    slots = m._parts.registry.topology.slots((voxels // 8).astype(np.int32))
    inside = voxels % 8
    return scores[slots, (inside[:, 0] * 8 + inside[:, 1]) * 8 + inside[:, 2]]


def passing(voxel: NDArray[np.int64], x_m: float, there: bool, sigma_m: float = 0.004) -> int:
    """How many rays of a camera at (x, 0, 0) lie in a voxel for more than a tenth of its size, and leave it
    three sigmas before what they measure if that is the post, which no voxel explains."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    to = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    faces = (np.stack([voxel, voxel + 1]) * VOXEL - [x_m, 0, 0])[:, None, None] / to
    enters, leaves = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
    depth_m = depth_image(x_m, there)
    before = (depth_m == np.float32(WALL_M)) | (leaves <= depth_m - 3 * sigma_m)
    return int(((leaves - enters) * np.linalg.norm(to, axis=-1) > 0.1 * VOXEL)[before].sum())


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize(("sigma_m", "says"), [(0.004, 78), (0.02, 40)])
def test_scores_are_those_of_keyframes_with_ends_and_without(sigma_m: float, says: int) -> None:
    """A nat is 20: log(1 / .02) for an end with a sigma of at most a quarter of a voxel, log(1 / .135) for
    another, and up to 1.5 against for each keyframe whose rays pass."""
    there = ALWAYS.copy()
    there[[2, 5, 6]] = False
    m = mapped(there, PolynomialNoise(sigma=(sigma_m,)))
    m.infer()
    post = np.floor(post_points() / VOXEL).astype(np.int64)
    against = [sum(min(passing(k, x_m, False), 30) for x_m in STEPS_M[~there]) for k in post]
    np.testing.assert_array_equal(scores_of(m, post), 7 * says - np.array(against))
    if says == 78:
        around = np.concatenate([np.add(post, (0, 0, z)) for z in (-4, -2, 1)])  # in the same brick
        by_hand = np.array([[passing(k, *each) for each in zip(STEPS_M, there, strict=True)] for k in around])
        assert by_hand.min() < 30 < by_hand.max()
        np.testing.assert_array_equal(scores_of(m, around), -np.minimum(by_hand, 30).sum(axis=1))


@pytest.mark.usefixtures("backend")
def test_a_keyframe_whose_rays_all_end_in_a_voxel_says_nothing() -> None:
    m = MRFMap(VOXEL, NOISE)
    m.add_keyframe(depth_image(0.025, with_post=False), pose(0.025), CAMERA)  # above the voxel's middle
    m.infer()
    wall = np.array([[0, 0, 40]])
    assert m.state((wall + 0.5) * VOXEL) == OCCUPIED
    assert scores_of(m, wall) == 0


@pytest.mark.usefixtures("backend")
def test_in_a_world_that_may_change_scores_fade_in_the_order_of_stamps() -> None:
    """A quarter of what speaks for matter, a sixteenth of what speaks against it."""
    there = np.array([False, False, False, True, True, False, True, False, False, False])
    m = mapped(there, time=TimeConfig(half_life_s=LIVE_HALF_LIFE_S))
    m.infer()
    post = np.floor(post_points() / VOXEL).astype(np.int64)
    wanted = []
    for voxel in post:
        score = 0
        for x_m, is_there in zip(STEPS_M, there, strict=True):
            score -= score >> (2 if score > 0 else 4)
            score += 78 if is_there else -min(passing(voxel, x_m, False), 30)
        wanted.append(score)
    np.testing.assert_array_equal(scores_of(m, post), wanted)


@pytest.mark.usefixtures("backend")
def test_order_freezing_and_a_file_keep_the_post(tmp_path: Path) -> None:
    m = mapped(ALWAYS, keep_surface=True)
    m.infer()
    whole = m.state(post_points())
    backwards = MRFMap(VOXEL, NOISE, keep_surface=True)
    for i in reversed(range(len(STEPS_M))):
        backwards.add_keyframe(depth_image(STEPS_M[i]), pose(STEPS_M[i]), CAMERA, f"{i}", float(i))
    backwards.infer()
    np.testing.assert_array_equal(backwards.state(post_points()), whole)
    for id in list(m.keyframes)[:5]:
        m.freeze_keyframe(id)
    m.infer()
    assert (m.state(post_points()) == OCCUPIED).all()
    m.save(tmp_path / "map.npz")
    np.testing.assert_array_equal(load_map(tmp_path / "map.npz").state(post_points()), m.state(post_points()))


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("backwards", [False, True])
def test_in_a_world_that_may_change_a_post_is_found_and_then_forgotten(backwards: bool) -> None:
    """Thirty views with it, the others without: what they say fades by a quarter with each."""
    there = np.arange(60) < 30
    stamps = np.arange(60)[::-1] if backwards else np.arange(60)
    m = MRFMap(VOXEL, NOISE, time=TimeConfig(half_life_s=LIVE_HALF_LIFE_S))
    states = []
    for i in stamps:
        x_m = STEPS_M[i % len(STEPS_M)]
        m.add_keyframe(depth_image(x_m, bool(there[i])), pose(x_m), CAMERA, f"{i}", float(i))
        if not backwards and i in (29, 59):
            m.infer()
            states.append(m.state(post_points()))
    m.infer()
    assert (m.state(post_points()) == FREE).all()
    if not backwards:
        assert (states[0] == OCCUPIED).all()
        assert (states[1] == FREE).all()


@pytest.mark.usefixtures("backend")
def test_just_before_a_larger_surface_a_post_makes_a_voxel_unknown() -> None:
    m, post_m = MRFMap(VOXEL, NOISE), 1.93
    for i, x_m in enumerate(STEPS_M):
        m.add_keyframe(depth_image(x_m, post_m=post_m), pose(x_m), CAMERA, f"{i}", float(i))
    m.infer()
    points = np.add(post_points(), (0.0, 0.0, post_m - POST_M))
    assert (m.marginals.occupancy(points) < 0.05).all()
    assert not np.isin(m.state(points), (FREE, OCCUPIED)).any()


@pytest.mark.usefixtures("backend")
def test_a_file_whose_frozen_keyframes_left_no_scores_is_read(tmp_path: Path) -> None:
    """As version 1.0.0 wrote it."""
    m = mapped(ALWAYS, keep_surface=True)
    m.infer()
    for id in list(m.keyframes):
        m.freeze_keyframe(id)
    m.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        arrays = {name: file[name] for name in file.files if name != MANIFEST}
    arrays["frozen_vote_sums"] = arrays["frozen_vote_sums"][..., :1]
    np.savez(tmp_path / "old.npz", **arrays)
    with zipfile.ZipFile(tmp_path / "old.npz") as archive:
        arrays[MANIFEST] = np.array(manifest_lines(iter(archive.infolist())))
    np.savez(tmp_path / "old.npz", **arrays)
    new, old = load_map(tmp_path / "map.npz"), load_map(tmp_path / "old.npz")
    wall = np.stack([np.linspace(-0.3, 0.3, 7), np.zeros(7), np.full(7, WALL_M)], axis=1)
    np.testing.assert_array_equal(old.state(wall), new.state(wall))
    assert (new.state(post_points()) == OCCUPIED).all()
    assert not (old.state(post_points()) == OCCUPIED).any()


def verdicts_by_numpy(
    occupied: NDArray[np.bool_], score: NDArray[np.int64], reach: int, most: int
) -> NDArray[np.int8]:
    """2 for voxels of a box that are occupied by their score, 1 for others in doubt, 0 for all others."""
    matter = occupied | (score > 0)
    enough = (score // 2 >= 21) & ~occupied

    def number(of: NDArray[np.bool_], *within: int) -> NDArray[np.int64]:
        padded = np.pad(of.astype(np.int64), [(w, w) for w in within])
        sizes = tuple(2 * w + 1 for w in within)
        return np.lib.stride_tricks.sliding_window_view(padded, sizes).sum(axis=(3, 4, 5))

    rods = np.zeros(occupied.shape, bool)
    for axis in range(3):
        within = [reach] * 3
        within[axis] = 0
        filled = np.moveaxis(number(matter, *within), axis, 0)
        thin_layer = (filled > 0) & (filled <= most)
        for column in np.ndindex(thin_layer.shape[1:]):
            row = thin_layer[(slice(None), *column)]
            for begin in range(len(row) - reach):
                if row[begin : begin + reach + 1].all():
                    np.moveaxis(rods, axis, 0)[(slice(begin, begin + reach + 1), *column)] = True
    found = enough & (rods | (number(occupied, 3, 3, 3) <= 3))
    for _ in range(2):
        found |= enough & (number(found, 1, 1, 1) > 0) & (number(occupied, 1, 1, 1) <= 3)
    doubted = (score > 0) & ~occupied & ((number(occupied, 3, 3, 3) <= 3) | (score // 2 >= 60))
    return np.where(found, 2, doubted).astype(np.int8)


@pytest.mark.compilers
@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("voxel_size", [0.2, 0.05, 0.02])
def test_what_scores_decide_is_what_numpy_finds(voxel_size: float) -> None:
    """Rods, plates and crumbs in a box of 3^3 bricks, in any order of slots, with nothing around it."""
    draw = np.random.default_rng(5)
    side, prior, least = 24, -2.2, 0.1
    occupied, score = np.zeros((side,) * 3, bool), np.full((side,) * 3, -9, np.int64)
    occupied[:, :, 2] = True
    score[:, :, 3][draw.random((side, side)) < 0.5] = 60
    score[:, :, 4][draw.random((side, side)) < 0.2] = 130
    occupied[4:9, 4:9, 12:15] = True
    for x, y, width in ((15, 4, 1), (15, 18, 2), (5, 17, 4)):
        score[x : x + width, y : y + width, 3:22] = draw.integers(30, 90, (width, width, 19))
    crumbs = draw.integers(3, side, (60, 3))
    score[tuple(crumbs.T)] = draw.integers(-20, 90, 60)
    log_odds = np.where(occupied, 2.0, -5.0).astype(np.float32)

    bricks = np.stack(np.unravel_index(draw.permutation(27), (3, 3, 3)), axis=1).astype(np.int32)
    cells = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
    places = tuple((bricks[:, None] * 8 + cells).reshape(-1, 3).T)
    votes, values = ti.ndarray(ti.i32, 2 * 27 * 512), ti.ndarray(ti.f32, 27 * 512)
    votes.from_numpy(np.stack([0 * score[places], score[places]], axis=1).reshape(-1).astype(np.int32))
    values.from_numpy(log_odds[places])
    call_matter(votes, values, bricks, np.arange(27, dtype=np.int32), voxel_size, prior, least)

    reach, most = {0.2: (3, 4), 0.05: (4, 5), 0.02: (8, 16)}[voxel_size]
    wanted = verdicts_by_numpy(occupied, score, reach, most)[places]
    decided, was = values.to_numpy(), log_odds[places]
    assert {0, 1, 2} == set(wanted.tolist())
    evidence = np.clip(prior + 0.1 * (score[places] // 2), 0.01, 5.0)  # above even odds, at most sure
    np.testing.assert_allclose(decided[wanted == 2], evidence[wanted == 2], rtol=1e-6)
    np.testing.assert_array_equal(decided[wanted == 1], np.float32(prior))
    np.testing.assert_array_equal(decided[wanted == 0], was[wanted == 0])
