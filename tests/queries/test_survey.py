"""Surfaces that a view's rays meet in maps made by hand, against closed forms and an oracle in float64."""

import math

import numpy as np
import pytest
from hand_made import (
    CAMERA,
    PRIOR,
    SQUARE_ON,
    THIN,
    VIEWS,
    VOXEL,
    HandMade,
    profile_of,
    rays_into,
    row_of_voxels,
    row_pose,
    surveyed,
)
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles.forward import Noise
from oracles.survey import SLIVER, Surveyed

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.queries.survey import Occlusion, SurfaceSurvey, doubting
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.noise import PatchNoise, PolynomialNoise
from taichi_mrf.voxels.pool import BrickPool

# Written out, and not imported: these tests hold the values.
OPAQUE = 0.001

pytestmark = pytest.mark.usefixtures("backend")

MAX_DEPTH = 5.0
PATCH = 16
PATCHES = (3, 3)

NOISY = np.random.default_rng(5)
SIGMA = NOISY.uniform((0.01, -0.002, 0.001), (0.04, 0.002, 0.004), (9, 3))
BIAS = NOISY.uniform((-0.02, -0.01, 0.0), (0.02, 0.01, 0.004), (9, 3))
NOISE = PatchNoise(SIGMA, BIAS, PATCH, CAMERA)


def noise_at(u: int, v: int) -> Noise:
    row = v // PATCH * PATCHES[1] + u // PATCH
    return Noise(tuple(SIGMA[row]), tuple(BIAS[row]))


def measured_in(hand: HandMade, T: Pose, seed: int) -> NDArray[np.float32]:
    """Depths around the map's surfaces, a fifth of them anywhere, and a tenth of the pixels without one."""
    random = np.random.default_rng(seed)
    surface = View(hand.pool, VOXEL, VolumeConfig()).render_depth(CAMERA, T, MAX_DEPTH)
    depth = surface + random.normal(0, 1.5 * VOXEL, CAMERA.shape)
    stray = (random.random(CAMERA.shape) < 0.2) | np.isnan(depth)
    depth[stray] = random.uniform(0.2, MAX_DEPTH, stray.sum())
    depth[random.random(CAMERA.shape) < 0.1] = 0
    return np.maximum(depth, 0).astype(np.float32)


def assert_same(found: SurfaceSurvey, expected: Surveyed) -> None:
    """Mask of pixels where rounding has no say. The bounds are some five times what was seen."""
    slivers = (found.far > 0) & (found.far - found.near < SLIVER * VOXEL)
    clear = expected.clear & ~slivers
    assert clear[expected.far > 0].mean() > 0.8
    np.testing.assert_allclose(found.near[clear], expected.near[clear], rtol=0, atol=1e-3 * VOXEL)
    np.testing.assert_allclose(found.far[clear], expected.far[clear], rtol=0, atol=1e-3 * VOXEL)
    np.testing.assert_allclose(found.middle, 0.5 * (found.near + found.far))
    np.testing.assert_allclose(found.visibility[clear], expected.visibility[clear], rtol=0, atol=2e-4)
    np.testing.assert_allclose(found.expected[clear], expected.expected[clear], rtol=0, atol=5e-4)
    np.testing.assert_allclose(found.likelihood[clear], expected.likelihood[clear], rtol=2e-3, atol=2e-3)


BOX = ((-2.2, 0.9, -1.3), (-0.3, 2.7, 0.5))


@pytest.mark.parametrize("number", range(len(VIEWS)))
@pytest.mark.parametrize("box", [None, BOX], ids=["everywhere", "in_a_box"])
def test_a_survey_follows_eqs_15_to_18(random_map: HandMade, number: int, box: tuple | None) -> None:
    T = VIEWS[number]
    measured = measured_in(random_map, T, number)
    volume = VolumeConfig() if box is None else VolumeConfig(lower=box[0], upper=box[1])
    view = View(random_map.pool, VOXEL, volume)
    found = view.survey(CAMERA, T, MAX_DEPTH, measured, NOISE.table(CAMERA))
    expected = surveyed(random_map, T, MAX_DEPTH, measured, noise_at, box)
    assert ((expected.far > 0) & (expected.likelihood > 0.1)).sum() > 40
    assert_same(found, expected)


def test_a_survey_ends_at_its_greatest_depth(random_map: HandMade) -> None:
    measured = measured_in(random_map, VIEWS[0], 7)
    found = View(random_map.pool, VOXEL, VolumeConfig()).survey(
        CAMERA, VIEWS[0], 2.0, measured, NOISE.table(CAMERA)
    )
    assert 1.9 < found.far.max() <= 2.0
    assert_same(found, surveyed(random_map, VIEWS[0], 2.0, measured, noise_at))


DENSE = 2.0
"""The log-odds that made_at_random gives its dense voxels, all the same."""


@pytest.mark.parametrize("occlusion", [{"unknown": DENSE}, {"empty_below": -3.0}, {"empty_below": DENSE}])
def test_some_voxels_let_every_ray_through(random_map: HandMade, occlusion: dict[str, float]) -> None:
    measured = measured_in(random_map, VIEWS[0], 3)
    whole = View(random_map.pool, VOXEL, VolumeConfig())
    all_dim = whole.survey(CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA))
    for view in (
        whole.with_occlusion(**occlusion),
        View(random_map.pool, VOXEL, VolumeConfig(), Occlusion(**occlusion)),
    ):
        found = view.survey(CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA))
        assert_same(found, surveyed(random_map, VIEWS[0], MAX_DEPTH, measured, noise_at, **occlusion))
        assert (np.maximum(found.visibility, OPAQUE) >= all_dim.visibility).all()
        assert (found.visibility > all_dim.visibility + 0.1).mean() > 0.05
    again = whole.survey(CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA))
    np.testing.assert_array_equal(again.near, all_dim.near)


@pytest.mark.parametrize("rule", [{"least": -2.5}, {"most": 0.5}, {"least": -4.0, "most": 1.0}])
def test_a_prediction_is_no_surer_than_its_rule_while_a_picture_is(
    random_map: HandMade, rule: dict[str, float]
) -> None:
    measured = measured_in(random_map, VIEWS[0], 3)
    plain = View(random_map.pool, VOXEL, VolumeConfig())
    view = View(random_map.pool, VOXEL, VolumeConfig(), predicting=Occlusion(**rule))
    found = view.survey(CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA), predicting=True)
    assert_same(found, surveyed(random_map, VIEWS[0], MAX_DEPTH, measured, noise_at, **rule))
    sure = view.survey(CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA))
    assert (np.abs(found.visibility - sure.visibility) > 0.01).mean() > 0.05
    pictures = (each.render_depth(CAMERA, VIEWS[0], MAX_DEPTH) for each in (view, plain))
    np.testing.assert_array_equal(*pictures)


@given(share=st.floats(1e-4, 1.0), passing=st.floats(1e-6, 0.4), prior=st.floats(1e-4, 0.9))
def test_doubt_is_a_share_of_the_prior_and_a_chance_to_pass(
    share: float, passing: float, prior: float
) -> None:
    rule = doubting(share, passing, prior)
    # A ray passes a voxel of probability p over its whole length with the chance 1 - p (eq. 15).
    least, most = (1.0 / (1.0 + np.exp(-bound)) for bound in (rule.least, rule.most))
    assert least == pytest.approx(share * prior, rel=1e-6)
    assert 1.0 - most == pytest.approx(passing, rel=1e-6)
    assert doubting(0.0, 0.0, prior) == Occlusion()


@pytest.mark.parametrize("occlusion", [{"unknown": DENSE}, {"empty_below": -3.0}])
def test_a_profile_knows_of_voxels_that_let_every_ray_through(
    random_map: HandMade, occlusion: dict[str, float]
) -> None:
    view = View(random_map.pool, VOXEL, VolumeConfig()).with_occlusion(**occlusion)
    dark = 0
    for origin, direction in rays_into(random_map, 80, seed=9):
        found = view.ray_profile(origin, direction, 3.0)
        expected = profile_of(random_map, origin, direction, 3.0, **occlusion)
        mine = found.length > SLIVER * VOXEL
        theirs = expected.far - expected.near > SLIVER * VOXEL
        np.testing.assert_allclose(found.visibility[mine], expected.visibility[theirs], atol=2e-3)
        np.testing.assert_allclose(found.occupancy[mine], expected.occupancy[theirs], atol=1e-5)
        np.testing.assert_array_equal(found.omega[mine] > 0, expected.omega[theirs] > 0)
        dark += (expected.omega == 0).sum()
    assert dark > 10


def test_pixels_without_a_measurement_are_not_followed(random_map: HandMade) -> None:
    measured = measured_in(random_map, VIEWS[0], 4)
    found = View(random_map.pool, VOXEL, VolumeConfig()).survey(
        CAMERA, VIEWS[0], MAX_DEPTH, measured, NOISE.table(CAMERA)
    )
    without = measured == 0
    assert 100 < without.sum() < measured.size / 2
    for image, value in (
        (found.near, 0), (found.far, 0), (found.middle, 0), (found.visibility, 1), (found.expected, 0),
        (found.likelihood, 0),
    ):  # fmt: skip
        np.testing.assert_array_equal(image[without], value)
    assert (found.far[~without] > 0).mean() > 0.5


def test_what_was_never_mapped_stops_no_ray(random_map: HandMade) -> None:
    away = look_at((3, -3, 0), (9, -9, 0))
    for pool, T in ((BrickPool(PRIOR), VIEWS[0]), (random_map.pool, away)):
        found = View(pool, VOXEL, VolumeConfig()).survey(
            CAMERA, T, MAX_DEPTH, np.ones(CAMERA.shape, np.float32), NOISE.table(CAMERA)
        )
        assert (found.visibility == 1).all()
        assert not any(image.any() for image in (found.near, found.far, found.expected, found.likelihood))


def row_survey(
    log_odds: list[float], measured: float, camera_x: float = -0.5, max_depth: float = MAX_DEPTH
) -> SurfaceSurvey:
    """A row of voxels from x = 0 on, seen square on by a camera at ``camera_x``, in metres."""
    T = row_pose(camera_x)
    return View(row_of_voxels(log_odds), VOXEL, VolumeConfig()).survey(
        SQUARE_ON, T, max_depth, np.full((1, 1), measured, np.float32), ROW_NOISE.table(SQUARE_ON)
    )


ROW_NOISE = PolynomialNoise((0.02,), (0.01,))


def log_odds_of(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


def test_a_single_opaque_voxel_is_the_surface() -> None:
    """Voxel 5 of the row: from 0.75 to 0.80 m."""
    found = row_survey([*[THIN] * 5, 20.0, *[THIN] * 10], measured=0.79)
    assert found.near[0, 0] == pytest.approx(0.75, abs=1e-6)
    assert found.far[0, 0] == pytest.approx(0.80, abs=1e-6)
    assert found.middle[0, 0] == found.expected[0, 0] == pytest.approx(0.775, abs=1e-6)
    assert found.visibility[0, 0] == pytest.approx(np.exp(-20.0), rel=1e-3)
    # The measurement lies 0.5 sigma below what the voxel's far end gives on average, 2 above the near end's.
    nearest, farthest = (0.79 - 0.01 - 0.75) / 0.02, (0.79 - 0.01 - 0.80) / 0.02
    between = 0.5 * (math.erf(nearest / math.sqrt(2)) - math.erf(farthest / math.sqrt(2)))
    assert found.likelihood[0, 0] == pytest.approx(between / 0.05, rel=1e-4)


@pytest.mark.parametrize(
    ("front", "behind", "winner"), [(0.7, 0.9, 0), (0.3, 0.9, 1), (0.5, 0.7, 0), (0.2, 0.9, 1)]
)
def test_a_thin_voxel_can_hide_a_denser_one(front: float, behind: float, winner: int) -> None:
    """The paper's Fig. 3: occupancy decides where the ray still gets to, not everywhere."""
    odds = [*[THIN] * 4, log_odds_of(front), THIN, log_odds_of(behind), *[THIN] * 9]
    found = row_survey(odds, measured=0.8)
    omegas = (-math.log(1 - front), -math.log(1 - behind) * (1 - front))
    assert (omegas[1] > omegas[0]) == winner
    assert found.near[0, 0] == pytest.approx(0.5 + (4 + 2 * winner) * VOXEL, abs=1e-6)
    assert found.visibility[0, 0] == pytest.approx((1 - front) * (1 - behind), rel=1e-4)
    shares = front, (1 - front) * behind
    expected = (shares[0] * 0.725 + shares[1] * 0.825) / sum(shares)
    assert found.expected[0, 0] == pytest.approx(expected, abs=1e-5)


def test_a_ray_that_is_hardly_dimmed_still_has_a_mean_depth() -> None:
    """Seen to be free for certain, met for a tenth of a millimetre: 1 - e^-x rounds to nothing there."""
    found = row_survey([-12.0, *[THIN] * 7], measured=0.01, camera_x=VOXEL - 1e-4)
    assert found.visibility[0, 0] == 1
    assert 0 < found.expected[0, 0] < 1e-3
