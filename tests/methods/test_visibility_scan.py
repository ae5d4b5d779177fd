# ruff: noqa: ANN202
"""The steps of a scan with visibility: each equation against the oracle and worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import visibility as reference

from taichi_mrf.config.sections import VisibilityConfig
from taichi_mrf.methods.visibility import scan
from taichi_mrf.methods.visibility.plug import TABLE_I
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, I32Array, Vec4
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.traversal import Space
from taichi_mrf.voxels.window import Window, WindowIndex

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

VOXEL = 0.2
MODEL = (TABLE_I.hit_if_occupied, TABLE_I.hit_if_free, TABLE_I.hit_if_hidden)
RULES = (TABLE_I.visible_if_occluded, TABLE_I.visible_if_clear, TABLE_I.q_min, TABLE_I.q_max)

probabilities = st.just(0.0) | st.floats(1e-6, 1.0)
between = st.floats(0.015625, 0.984375, width=32)


@ti.kernel
def _interpolated(occupied: F32, visible: F32, inside: F32, model: Vec4, out: F32Array):
    for _ in range(1):
        out[0] = scan.interpolated(occupied, visible, inside, model[0], model[1], model[2])


@ti.kernel
def _visibility(before: F32, occluded: F32, rules: Vec4, out: F32Array):
    for _ in range(1):
        out[0] = scan.visibility(before, occluded, rules[0], rules[1], rules[3])


@ti.kernel
def _inside(depth: F32, measured: F32, sigma: F32, out: F32Array):
    for _ in range(1):
        out[0] = scan.inside_obstacle(depth, measured, sigma)


def interpolated(occupied: float, visible: float, inside: float, model: tuple[float, ...] = MODEL) -> float:
    out = np.zeros(1, np.float32)
    _interpolated(occupied, visible, inside, ti.Vector([*model, 0.0], ti.f32), out)
    return float(out[0])


def visibility(before: float, occluded: float) -> float:
    out = np.zeros(1, np.float32)
    _visibility(before, occluded, ti.Vector(list(RULES), ti.f32), out)
    return float(out[0])


def inside_obstacle(depth: float, measured: float, sigma: float) -> float:
    out = np.zeros(1, np.float32)
    _inside(depth, measured, sigma, out)
    return float(out[0])


def logit(p: float) -> float:
    return math.log(p / (1 - p))


# Equations 4 to 6 and 8.


@given(between, probabilities, probabilities, between, between, between)
def test_an_update_is_the_papers(
    occupied: float, visible: float, inside: float, if_occupied: float, if_free: float, if_hidden: float
) -> None:
    config = VisibilityConfig(hit_if_occupied=if_occupied, hit_if_free=if_free, hit_if_hidden=if_hidden)
    expected = reference.interpolated(occupied, visible, inside, config)
    assert interpolated(occupied, visible, inside, (if_occupied, if_free, if_hidden)) == pytest.approx(
        expected, abs=1e-6
    )


@given(between)
def test_a_visible_voxel_follows_bayes_rule(occupied: float) -> None:
    odds = occupied / (1 - occupied)
    hit, miss = odds * 0.55 / 0.43, odds * 0.45 / 0.57
    assert interpolated(occupied, 1.0, 1.0) == pytest.approx(hit / (1 + hit), abs=1e-6)
    assert interpolated(occupied, 1.0, 0.0) == pytest.approx(miss / (1 + miss), abs=1e-6)


# Equations 2, 3 and 7.


@given(st.lists(probabilities, max_size=20))
def test_visibility_along_a_ray_is_the_papers(occluded: list[float]) -> None:
    before, along = 1.0, []
    for c in occluded:
        before = visibility(before, c)
        along.append(before)
    expected = reference.visibilities(occluded, replace(TABLE_I, q_min=0.0))
    close_call = any(abs(v - TABLE_I.q_max) < 1e-5 for v in raw_visibilities(occluded))
    if not close_call:  # float32 and float64 may fall on either side of q_max
        np.testing.assert_allclose(along, expected, atol=1e-5)


def raw_visibilities(occluded: list[float]) -> list[float]:
    """The visibilities before they are clamped."""
    out, before = [], 1.0
    for c in occluded:
        out.append(before * (1 - 0.8 * c))
        before = 1.0 if out[-1] >= TABLE_I.q_max else out[-1]
    return out


@given(st.floats(0.1, 20.0), st.floats(0.1, 20.0), st.floats(0.005, 2.0))
def test_inside_is_the_normal_distribution(depth: float, measured: float, sigma: float) -> None:
    depth, measured, sigma = (float(np.float32(x)) for x in (depth, measured, sigma))
    expected = reference.inside(depth, measured, sigma)
    assert inside_obstacle(depth, measured, sigma) == pytest.approx(expected, abs=1e-5)
    assert inside_obstacle(measured, measured, sigma) == pytest.approx(0.5, abs=1e-6)


def test_sure_is_where_the_oracle_has_it() -> None:
    assert reference.SURE == scan.SURE
    assert reference.inside(scan.SURE_SIGMAS, 0.0, 1.0) == pytest.approx(scan.SURE)


# Equation 1, for every voxel of some bricks.


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0.0, 1.0),
    sensor=st.tuples(*[st.floats(0.0, 64.0)] * 3),
    low=st.tuples(*[st.integers(0, 20)] * 3),
    high=st.tuples(*[st.integers(40, 64)] * 3),
)
def test_local_occlusion_is_the_papers_across_bricks(
    seed: int,
    share: float,
    sensor: tuple[float, float, float],
    low: tuple[int, int, int],
    high: tuple[int, int, int],
) -> None:
    rng = np.random.default_rng(seed)
    window = Window((0, 0, 0), (8, 8, 8), VOXEL)
    # Bricks here and there, among them some that are next to each other, and log-odds in them.
    corner = rng.integers(0, 7, 3)
    block = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) + corner
    bricks = block[rng.random(len(block)) < max(share, 0.2)].astype(np.int32)
    cells, slots = window.cells_of(bricks), rng.permutation(len(bricks)).astype(np.int32)
    log_odds = rng.normal(0, 1.5, len(bricks) * VOXELS).astype(np.float32)

    index = WindowIndex()
    index.fill(window, cells, slots)
    belief = on_device(log_odds, ti.f32)
    occluded, visible, inside = scratch(len(bricks))
    centre = np.asarray(sensor, np.float32)
    lower, upper = (ti.Vector([float(x) for x in corner], ti.f32) for corner in (low, high))
    space = Space(window.shape_vector, lower, upper, index.chunks, index.bricks)
    seen = scan.SeenVoxels(occluded, visible, inside)
    scan.hide(cells, ti.Vector(centre.tolist(), ti.f32), space, belief, seen)

    offsets = np.stack(np.unravel_index(np.arange(VOXELS), (BRICK,) * 3), axis=1)
    known = {}
    for brick, slot in zip(bricks, slots.tolist(), strict=True):
        odds = log_odds[slot * VOXELS : (slot + 1) * VOXELS].astype(np.float64)
        voxels = map(tuple, (brick * BRICK + offsets).tolist())
        known.update(zip(voxels, (1 / (1 + np.exp(-odds))).tolist(), strict=True))
    box = (tuple(map(float, low)), tuple(map(float, high)))
    here = tuple(int(c) for c in np.floor(centre))
    expected = [
        reference.local_occlusion(known, tuple(v), here, box)
        for brick in bricks
        for v in (brick * BRICK + offsets).tolist()
    ]
    np.testing.assert_allclose(occluded.to_numpy()[: len(expected)], expected, atol=1e-6)


# Rows of voxels.


def on_device(values: np.ndarray, dtype: object) -> "ti.Ndarray":
    array = ti.ndarray(dtype, max(1, len(values)))
    if len(values):
        array.from_numpy(values)
    return array


def scratch(bricks: int) -> tuple["ti.Ndarray", "ti.Ndarray", "ti.Ndarray"]:
    n = max(1, bricks) * VOXELS
    return ti.ndarray(ti.f32, n), ti.ndarray(ti.i32, n), ti.ndarray(ti.i32, n)


@ti.kernel
def _seen(values: F32Array, bits: I32Array):
    for i in range(values.shape[0]):
        bits[i] = ti.bit_cast(values[i], ti.i32)


@given(st.lists(st.floats(-3.5, 3.5, width=32, allow_subnormal=False), min_size=1, max_size=30), st.data())
@settings(max_examples=30)
def test_voxels_are_updated_within_bounds_and_only_if_seen(
    log_odds: list[float], data: st.DataObject
) -> None:
    n = len(log_odds)
    visible = np.array([data.draw(probabilities) for _ in range(n)], np.float32)
    inside = np.array([data.draw(probabilities) for _ in range(n)], np.float32)
    before = np.zeros(2 * VOXELS, np.float32)
    before[VOXELS : VOXELS + n] = log_odds  # the scan's only brick has slot 1
    belief, bits = on_device(before, ti.f32), scratch(1)[1:]
    for array, values in zip(bits, (visible, inside), strict=True):
        array.fill(0)
        _seen(values, array)
    scan.update(np.array([1], np.int32), belief, *bits, *MODEL, logit(TABLE_I.lowest), logit(TABLE_I.highest))
    after = belief.to_numpy()
    np.testing.assert_array_equal(after[:VOXELS], 0.0)
    np.testing.assert_array_equal(after[VOXELS + n :], 0.0)
    for i in range(n):
        if visible[i] == 0:
            assert after[VOXELS + i] == before[VOXELS + i]
            continue
        p = reference.interpolated(
            1 / (1 + math.exp(-log_odds[i])), float(visible[i]), float(inside[i]), TABLE_I
        )
        p = min(max(p, TABLE_I.lowest), TABLE_I.highest)
        assert after[VOXELS + i] == pytest.approx(logit(p), abs=2e-5)
