"""Bounds for free space: against isotonic regression by its definition, in simulated blocks, and in maps."""

from itertools import combinations

import numpy as np
import pytest
import small_room

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.free_space import (
    STEPS,
    _ended_in,
    _sees,
    averaged,
    bounds_of,
    calibrate_free,
    certain_ends,
    held_share,
    rising_share,
)
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.free import LEVELS, NEVER
from taichi_mrf.sensor.camera import PinholeCamera

BINS = len(STEPS) + 1


def rising_by_definition(ends: np.ndarray, visited: np.ndarray) -> np.ndarray:
    """max over begins of min over ends of the pooled share: the formula of isotonic regression."""
    n = len(ends)
    pooled = {
        (a, b): ends[a : b + 1].sum() / visited[a : b + 1].sum()
        for a, b in [*combinations(range(n), 2), *((i, i) for i in range(n))]
    }
    return np.array([
        max(min(pooled[a, b] for b in range(i, n)) for a in range(i + 1)) for i in range(n)
    ])  # fmt: skip


def test_shares_rise_as_isotonic_regression_has_them() -> None:
    draw = np.random.default_rng(1)
    for _ in range(20):
        visited = draw.integers(1, 50, 12).astype(float)
        ends = np.floor(visited * draw.uniform(0, 1, 12) * np.linspace(0.1, 1, 12))
        np.testing.assert_allclose(rising_share(ends, visited), rising_by_definition(ends, visited))


def test_the_worst_block_counts_twice() -> None:
    """Blocks of two shares in all bins but the last, in which matter is everywhere: by hand."""
    visited = np.zeros((4, BINS))
    visited[:, 10], visited[:, -20] = 1000, 1000
    ends = np.zeros((4, BINS))
    ends[:, -20] = 900
    ends[0, 10] = 60  # pooled twice: (60 + 60) / 5000 = .024
    bounds = dict(zip(LEVELS, bounds_of(ends, visited), strict=True))
    assert bounds[0.95] == STEPS[BINS - 21]  # everything before the bin with matter
    assert bounds[0.98] < STEPS[10]  # .024 > .02, and .015, without the second time, is not
    ends[0, 10] = 40  # .016
    assert bounds_of(ends, visited)[LEVELS.index(0.98)] == STEPS[BINS - 21]


def test_a_level_needs_voxels_enough() -> None:
    visited, ends = np.zeros((3, BINS)), np.zeros((3, BINS))
    visited[:, 5] = 50  # 150 voxels without an end: a share of 1 / 50 or less, 19 times in 20
    bounds = bounds_of(ends, visited)
    assert [level for level, bound in zip(LEVELS, bounds, strict=True) if bound > NEVER] == [
        0.8,
        0.9,
        0.95,
        0.98,
    ]
    assert (np.diff(bounds) <= 0).all()


def test_new_blocks_hold_what_is_promised() -> None:
    """Exchangeable blocks, each with its own share of matter: on average over the blocks to come the bin that
    is just allowed has a share of at most 1 - p."""
    draw = np.random.default_rng(2)
    log_odds = np.concatenate([[-13], STEPS])
    truth = 1 / (1 + np.exp(-log_odds - 1))
    at_bound: dict[float, list[float]] = {level: [] for level in LEVELS[:5]}
    for _ in range(60):
        factor = draw.lognormal(0, 0.5, 11)
        share = np.minimum(truth * factor[:, None], 1)
        visited = np.full((11, BINS), 2000.0)
        ends = draw.binomial(2000, share).astype(float)
        bounds = bounds_of(ends[:10], visited[:10])
        for level, bound in zip(LEVELS, bounds, strict=True):
            if level in at_bound:
                last = int(np.flatnonzero(np.append(STEPS, np.inf) <= bound)[-1])
                at_bound[level].append(share[10, last])
    for level, shares in at_bound.items():
        assert np.mean(shares) <= (1 - level) * 1.02
        assert np.mean(shares) >= (1 - level) * 0.6  # and not for nothing


def test_what_a_block_holds_is_judged_by_the_others() -> None:
    visited, ends = np.zeros((4, BINS)), np.zeros((4, BINS))
    visited[:, 10] = 1000
    ends[3, 10] = 300
    held = held_share(ends, visited)
    np.testing.assert_allclose(held[3, 0], 0.7)
    np.testing.assert_allclose(held[:3, 0], 1.0)
    # By its own ends, twice 300 of 5000, the last block's bin would not be free at 95%.
    np.testing.assert_allclose(held[3, LEVELS.index(0.95)], 0.7)


def test_ends_are_averaged_within_planes_only() -> None:
    draw = np.random.default_rng(3)
    true_m = np.tile(np.linspace(1, 1.4, 60), (50, 1))
    true_m[:, 40:] += 1.0
    sigma_m = np.full(true_m.shape, 0.01)
    noisy_m = true_m + draw.normal(0, 0.01, true_m.shape)
    noisy_m[0, 0] = 0
    found_m, found_sigma_m = averaged(noisy_m, sigma_m)
    assert found_m[0, 0] == 0
    inner = np.s_[2:-2, 2:36]
    np.testing.assert_allclose(np.median(found_sigma_m[inner]), 0.01 / 5)
    assert np.std((found_m - true_m)[inner]) < 0.0035
    assert np.abs(found_m - true_m)[1:].max() < 0.05  # nothing lies between the two planes


def test_uncertain_ends_do_not_count() -> None:
    depth_m = np.full((20, 20), 2.0)
    assert (certain_ends(depth_m, np.full((20, 20), 0.01), 0.05) > 0).all()
    assert (certain_ends(depth_m, np.full((20, 20), 0.5), 0.05) == 0).all()


CAMERA = PinholeCamera(40, 40, 160.0, 160.0, 19.5, 19.5)


def test_an_end_counts_if_one_ray_in_twenty_of_its_voxel_has_it() -> None:
    """At 1 m a voxel of 5 cm has (160 x .05)^2 = 64 rays."""
    ends_m, rays = np.full(CAMERA.shape, 2.0), CAMERA.rays()
    for pixels, counts in ((2, False), (5, True)):
        ends_m[20, 20 : 20 + pixels] = 1.01
        voxels = _ended_in(rays, ends_m, np.eye(4), 0.05)
        assert (voxels[:, 2] == 20).any() == counts
    assert (voxels[:, 2] == 40).sum() > 20


def test_a_frame_looks_into_what_lies_before_its_ends() -> None:
    depth_m = np.full(CAMERA.shape, 2.0)
    depth_m[:, :10] = 0
    points_m = np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, 2.2], [0, 0, -1.0], [0.5, 0, 1.0], [-0.1, 0, 1.0]])
    seen = _sees(CAMERA, CAMERA.rays(), depth_m, points_m, 0.05)
    # In front, where it ends, behind it, behind the camera, beside the image, where nothing was measured.
    assert seen.tolist() == [True, True, False, False, False, False]


@pytest.mark.usefixtures("one_backend")
def test_a_map_is_calibrated_by_frames_that_it_has_not_seen() -> None:
    dataset = open_dataset("synthetic:room?width=120&height=90&frames=20")
    frames = [dataset.read(i) for i in range(len(dataset))]
    m = MRFMap(small_room.VOXEL_SIZE)
    for i, frame in enumerate(frames):
        if i % 4 != 1:
            m.add(frame)
    with pytest.raises(ConfigError, match="infer"):
        calibrate_free(m, frames[1::4])
    m.infer()
    promise = calibrate_free(m, frames[1::4])
    assert promise is not None
    assert promise.blocks == 5
    assert (np.diff(promise.bound) <= 0).all()
    assert (promise.held_least <= promise.held_most).all()
    assert promise.held_least[LEVELS.index(0.9)] > 0.9
    assert (np.diff(promise.lost_m) >= 0).all()
    assert 0 < promise.lost_m[-1] <= 1.0  # of the last metre of a ray
    assert calibrate_free(m, frames[1:9:4]) is None
