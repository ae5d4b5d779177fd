"""How views are scored, against closed forms and against scores worked out from the oracle's survey."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hand_made import (
    BRICK_M,
    CAMERA,
    SQUARE_ON,
    THIN,
    VIEWS,
    VOXEL,
    HandMade,
    made_at_random,
    row_of_voxels,
    row_pose,
    surveyed,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from oracles.forward import Noise
from oracles.survey import Surveyed

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.errors import ConfigError, FrameError
from taichi_mrf.evaluation.accuracy import (
    MISSED,
    NO_ANSWER,
    NOT_JUDGED,
    RIGHT,
    WRONG,
    JudgedView,
    Tolerance,
    accuracy,
    boundary_depth,
    judge_view,
)
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.survey import SurfaceSurvey
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise
from taichi_mrf.voxels.pool import BrickPool

# Written out, and not imported: these tests hold the values.
OUTLIERS = 0.01
SURFACE_STD = 0.25
TOLERANCES = ("voxel", "1.5sigma", "5cm", "sensor")

pytestmark = pytest.mark.usefixtures("backend")

MAX_DEPTH = 5.0
SENSOR = SensorConfig(max_depth=MAX_DEPTH)
NOISE = PolynomialNoise((0.02, 0.001, 0.002), (-0.01, 0.02))
ORACLE_NOISE = Noise((0.02, 0.001, 0.002), (-0.01, 0.02))


@dataclass(frozen=True)
class PoolMap:
    """The least that a map must be to be judged."""

    pool: BrickPool
    voxel_size: float = VOXEL
    sensor: SensorConfig = SENSOR

    @property
    def view(self) -> View:
        return View(self.pool, self.voxel_size, VolumeConfig())

    def measured_depth(self, likeliest_m: NDArray, camera: PinholeCamera, T_world_camera: NDArray) -> NDArray:
        return np.full(camera.shape, np.nan, np.float32)


@dataclass(frozen=True)
class Case:
    """A view of the random map, the oracle's survey of it, and the pixels that no rounding decides."""

    judged: JudgedView
    expected: Surveyed
    depth: NDArray[np.float64]
    mask: NDArray[np.bool_]


def in_tolerance(case_depth: NDArray, expected: Surveyed, tolerance: Tolerance) -> tuple[NDArray, NDArray]:
    """True if a pixel is right, and by how much that is so, in metres."""
    middle = 0.5 * (expected.near + expected.far)
    if tolerance == "voxel":
        spare = np.minimum(case_depth - expected.near, expected.far - case_depth) + 0.01 * VOXEL
    elif tolerance == "1.5sigma":
        spare = 1.5 * VOXEL - np.abs(case_depth - middle)
    elif tolerance == "5cm":
        spare = 0.05 - np.abs(case_depth - middle)
    else:
        would_measure = middle + ORACLE_NOISE.bias_at(middle)
        spare = 1.5 * ORACLE_NOISE.sigma_at(middle) - np.abs(case_depth - would_measure)
    right = (expected.far > 0) & (spare >= 0)
    return right, np.where(expected.far > 0, np.abs(spare), np.inf)


@pytest.fixture(scope="module")
def random_map(backend: str) -> HandMade:
    return made_at_random(backend)


@pytest.fixture(scope="module", params=range(len(VIEWS)))
def case(random_map: HandMade, request: pytest.FixtureRequest) -> Case:
    T: Pose = VIEWS[request.param]
    random = np.random.default_rng(request.param)
    m = PoolMap(random_map.pool)
    surface = m.view.render_depth(CAMERA, T, MAX_DEPTH)
    depth = (surface + random.normal(0, VOXEL, CAMERA.shape)).astype(np.float32)
    stray = np.isnan(depth) | (random.random(CAMERA.shape) < 0.1)
    depth[stray] = random.uniform(0.2, MAX_DEPTH, stray.sum())
    expected = surveyed(random_map, T, MAX_DEPTH, depth, lambda u, v: ORACLE_NOISE)
    mask = expected.clear & (random.random(CAMERA.shape) < 0.9)
    for tolerance in TOLERANCES:
        mask &= in_tolerance(depth.astype(np.float64), expected, tolerance)[1] > 1e-3 * VOXEL
    judged = judge_view(m, depth, T, CAMERA, noise=NOISE, mask=mask)
    # Corners cut by next to nothing, which the oracle may not meet, are left out as well.
    slivers = (judged.survey.far > 0) & (judged.survey.far - judged.survey.near < 1e-3 * VOXEL)
    mask &= ~slivers
    return Case(judge_view(m, depth, T, CAMERA, noise=NOISE, mask=mask), expected, depth.astype(float), mask)


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_scores_are_those_of_the_oracles_survey(case: Case, tolerance: Tolerance) -> None:
    right, _ = in_tolerance(case.depth, case.expected, tolerance)
    answered = case.expected.far > 0
    assert case.mask.sum() > 1000
    assert 25 < (right & case.mask).sum() < case.mask.sum() - 25
    found = case.judged.accuracy(tolerance)
    assert found.score == pytest.approx(right[case.mask].mean(), abs=1e-12)
    assert found.unanswered == pytest.approx(1 - answered[case.mask].mean(), abs=1e-12)
    expected_image = np.select([~case.mask, ~answered, right], [NOT_JUDGED, NO_ANSWER, RIGHT], WRONG)
    assert found.image.dtype == np.int8
    np.testing.assert_array_equal(found.image, expected_image)


def test_depth_errors_are_those_of_the_oracles_survey(case: Case) -> None:
    answered = case.mask & (case.expected.far > 0)
    middle = 0.5 * (case.expected.near + case.expected.far)
    for found, depth in (
        (case.judged.depth_error(), middle),
        (case.judged.expected_depth_error(), case.expected.expected),
    ):
        error = (depth - case.depth)[answered]
        assert found.pixels == len(error)
        assert found.unanswered == pytest.approx(1 - len(error) / case.mask.sum())
        assert found.median == pytest.approx(np.median(error), abs=1e-4)
        assert found.median_abs == pytest.approx(np.median(np.abs(error)), abs=1e-4)
        assert found.rms == pytest.approx(np.sqrt(np.mean(error**2)), abs=1e-3)
    np.testing.assert_array_equal(np.isfinite(case.judged.answer_m), answered)


def test_the_log_likelihood_is_that_of_a_mixture_with_outliers(case: Case) -> None:
    explained = case.expected.likelihood + case.expected.visibility / MAX_DEPTH
    density = (1 - OUTLIERS) * explained + OUTLIERS / MAX_DEPTH
    assert case.judged.log_likelihood() == pytest.approx(np.log(density[case.mask]).mean(), abs=1e-3)


OPAQUE_VOXEL = 20.0


def judged_row(
    log_odds: list[float], measured: float, camera_x: float = -0.5, noise: NoiseModel | None = None
) -> JudgedView:
    """A row of voxels from x = 0 on, seen square on through their middles."""
    T = row_pose(camera_x)
    m = PoolMap(row_of_voxels(log_odds))
    return judge_view(m, np.full((1, 1), measured, np.float32), T, SQUARE_ON, noise=noise)


def scores(judged: JudgedView) -> dict[str, float]:
    return {tolerance: judged.accuracy(tolerance).score for tolerance in TOLERANCES}


ONE_WALL = [*[THIN] * 5, OPAQUE_VOXEL, *[THIN] * 10]
"""Seen from x = -0.5 m: from 0.75 to 0.80 m."""


@pytest.mark.parametrize(
    ("measured", "right"),
    [
        (0.775, {"voxel", "1.5sigma", "5cm", "sensor"}),
        (0.7503, {"voxel", "1.5sigma", "5cm", "sensor"}),
        (0.8003, {"voxel", "1.5sigma", "5cm", "sensor"}),
        (0.802, {"1.5sigma", "5cm", "sensor"}),
        (0.748, {"1.5sigma", "5cm", "sensor"}),
        (0.824, {"1.5sigma", "5cm", "sensor"}),
        (0.726, {"1.5sigma", "5cm", "sensor"}),
        (0.826, {"1.5sigma", "sensor"}),
        (0.849, {"1.5sigma", "sensor"}),
        (0.701, {"1.5sigma", "sensor"}),
        (0.851, set()),
        (0.699, set()),
        (3.0, set()),
    ],
)
def test_the_tolerances_of_a_single_opaque_voxel(measured: float, right: set[str]) -> None:
    """Without a noise model the sensor's sigma is one voxel, 5 cm."""
    assert {name for name, score in scores(judged_row(ONE_WALL, measured)).items() if score == 1} == right


@pytest.mark.parametrize(
    ("measured", "right"), [(0.775, False), (0.7901, True), (0.806, True), (0.8199, True), (0.8201, False)]
)
def test_the_sensors_tolerance_lies_around_what_it_would_measure(measured: float, right: bool) -> None:
    """A surface at 0.775 m is measured at 0.805 m, give or take 0.01 m."""
    judged = judged_row(ONE_WALL, measured, noise=PolynomialNoise((0.01,), (0.03,)))
    assert judged.accuracy("sensor").score == right


def test_half_a_voxels_shift_of_the_grid_changes_voxel_but_not_sigma() -> None:
    """One measured surface, with the grid before and behind it."""
    at_home = judged_row(ONE_WALL, 0.785)
    moved = judged_row(ONE_WALL, 0.785, camera_x=-0.5 + 0.5 * VOXEL)
    assert scores(at_home) == {"voxel": 1, "1.5sigma": 1, "5cm": 1, "sensor": 1}
    assert scores(moved) == {"voxel": 0, "1.5sigma": 1, "5cm": 1, "sensor": 1}


@pytest.mark.parametrize(("front", "hidden"), [(1.0, True), (-1.0, False)])
def test_a_thin_voxel_that_hides_a_denser_one_is_the_answer(front: float, hidden: bool) -> None:
    """The paper's Fig. 3. Occupied with 0.73, or 0.27, before one with 0.88."""
    assert (math.log1p(math.exp(front)) > math.log1p(math.exp(2.0)) / (1 + math.exp(front))) == hidden
    row = [*[THIN] * 4, front, *[THIN] * 3, 2.0, *[THIN] * 7]
    assert judged_row(row, 0.725).accuracy("voxel").score == hidden
    assert judged_row(row, 0.925).accuracy("voxel").score == (not hidden)


def test_rays_that_meet_nothing_are_unanswered_and_wrong(random_map: HandMade) -> None:
    away = look_at((3, -3, 0), (9, -9, 0))
    for m in (PoolMap(BrickPool(-2.2)), PoolMap(random_map.pool)):
        judged = judge_view(m, np.full(CAMERA.shape, 2.0), away, CAMERA, noise=NOISE)
        for tolerance in TOLERANCES:
            found = judged.accuracy(tolerance)
            assert (found.score, found.unanswered) == (0, 1)
            assert (found.image == NO_ANSWER).all()
        assert judged.depth_error().pixels == 0
        assert judged.depth_error().unanswered == 1
        # A ray that gets through may come back from anywhere.
        assert judged.log_likelihood() == pytest.approx(math.log(1 / MAX_DEPTH))


def test_an_opaque_wall_elsewhere_costs_no_more_than_an_outlier() -> None:
    assert judged_row(ONE_WALL, 3.0).log_likelihood() == pytest.approx(
        math.log(OUTLIERS / MAX_DEPTH), abs=1e-4
    )


def test_another_view_of_the_map_can_be_judged() -> None:
    m = PoolMap(row_of_voxels([*[THIN] * 3, 0.5, *[THIN] * 3, 3.0, *[THIN] * 8]))
    depth, T = np.full((1, 1), 0.875), row_pose(-0.5)
    empty = m.view.with_occlusion(empty_below=1.0)
    # Occupied with 0.62 before 0.95: omega is 0.97 there, 3.05 * 0.38 here.
    assert judge_view(m, depth, T, SQUARE_ON).survey.visibility < 0.1
    seen = judge_view(m, depth, T, SQUARE_ON, view=empty)
    assert seen.accuracy("voxel").score == 1
    assert seen.survey.expected[0, 0] == pytest.approx(0.875, abs=1e-5)


def test_a_mapped_wall_is_right_from_where_it_was_seen(backend: str) -> None:
    """A whole map: the wall lies in the middle of a layer of voxels; half of it was never seen."""
    camera = CAMERA.scaled(2.5)
    T = look_at((-3.31, 0.72, 1.13), (-3.31, 5.0, 1.13))
    wall = np.full(camera.shape, 2.055, np.float32)
    seen = wall.copy()
    seen[:, : camera.width // 2] = 0
    m = MRFMap(VOXEL, PolynomialNoise((0.01,)), surface_density=2.1)
    m.add_keyframe(seen, T, camera)
    m.infer()
    inside = np.zeros(camera.shape, bool)
    inside[5:-5, camera.width // 2 + 5 : -5] = True
    # "voxel" is too strict here: a slanting ray may meet two voxels of the layer and the first is the answer.
    for tolerance, least in (("voxel", 0.5), ("1.5sigma", 0.99), ("5cm", 0.99), ("sensor", 0.99)):
        found = accuracy(m, wall, T, camera, tolerance, mask=inside)  # type: ignore[arg-type]
        assert found.score > least
        assert found.unanswered == 0
        assert (found.image[~inside] == NOT_JUDGED).all()
    everywhere = judge_view(m, wall, T, camera)
    assert everywhere.accuracy("voxel").unanswered > 0.3
    assert everywhere.log_likelihood() < judge_view(m, wall, T, camera, mask=inside).log_likelihood()


@pytest.mark.parametrize(
    ("depth", "mask", "problem"),
    [
        (np.zeros(CAMERA.shape), None, "no pixel of 1728 can be judged: none holds a depth up to 5 m$"),
        (np.full(CAMERA.shape, np.nan), None, "no pixel of 1728 can be judged"),
        (np.full(CAMERA.shape, np.inf), None, "no pixel of 1728 can be judged"),
        (np.full(CAMERA.shape, -1.0), None, "no pixel of 1728 can be judged"),
        (np.full(CAMERA.shape, 5.1), None, "no pixel of 1728 can be judged"),
        (np.ones(CAMERA.shape), np.zeros(CAMERA.shape), "none holds a depth up to 5 m inside the mask"),
        (np.ones((48, 36)), None, r"shape \(48, 36\), but the camera has 36 rows and 48 columns"),
        (np.ones((*CAMERA.shape, 1)), None, r"shape \(36, 48, 1\)"),
        (np.ones(CAMERA.shape), np.ones((48, 36)), r"a mask has the shape \(48, 36\), its depth image \(36"),
    ],
)
def test_what_cannot_be_judged_is_refused(
    random_map: HandMade, depth: NDArray, mask: NDArray | None, problem: str
) -> None:
    with pytest.raises(FrameError, match=problem) as caught:
        judge_view(PoolMap(random_map.pool), depth, VIEWS[0], CAMERA, mask=mask)
    assert "\n" not in str(caught.value)


def test_a_tolerance_that_does_not_exist_is_refused(random_map: HandMade) -> None:
    m, depth = PoolMap(random_map.pool), np.ones(CAMERA.shape)
    problem = "there is no tolerance '3sigma'; choose from voxel, 1.5sigma, 5cm, sensor"
    with pytest.raises(ConfigError, match=problem):
        accuracy(m, depth, VIEWS[0], CAMERA, "3sigma")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=problem):
        judge_view(m, depth, VIEWS[0], CAMERA).accuracy("3sigma")  # type: ignore[arg-type]


SMALL = PinholeCamera(width=8, height=6, fx=8, fy=8, cx=3.4, cy=2.6)

rows = hnp.arrays(
    np.float32, st.integers(1, 24), elements=st.floats(-12, 12, width=32, allow_subnormal=False)
)
depths = hnp.arrays(
    np.float32,
    SMALL.shape,
    elements=st.one_of(
        st.just(0.0), st.just(math.nan), st.floats(0.0625, 6, width=32, allow_subnormal=False)
    ),
).filter(lambda depth: bool(((depth > 0) & (depth <= MAX_DEPTH)).any()))
cameras_x = st.floats(-1.0, 1.0, width=32, allow_subnormal=False)


@settings(max_examples=50)
@given(rows, depths, cameras_x)
def test_what_holds_for_every_score(row: NDArray, depth: NDArray, camera_x: float) -> None:
    T = look_at((camera_x, 0.21, 0.17), (camera_x + 1.0, 0.3, 0.24))
    judged = judge_view(PoolMap(row_of_voxels(row)), depth, T, SMALL, noise=NOISE)
    count = int(((depth > 0) & (depth <= MAX_DEPTH)).sum())
    assert judged.judged.sum() == count
    for tolerance in TOLERANCES:
        found = judged.accuracy(tolerance)
        assert 0 <= found.score <= 1 - found.unanswered + 1e-12 <= 1 + 1e-12
        shares = np.bincount(found.image.reshape(-1), minlength=4)
        assert shares[NOT_JUDGED] == depth.size - count
        assert shares[RIGHT] == pytest.approx(found.score * count)
        assert shares[NO_ANSWER] == pytest.approx(found.unanswered * count)
    inside = judged.accuracy("voxel").image == RIGHT
    diagonal = math.sqrt(3) * VOXEL
    assert (np.abs(judged.answer_m - judged.depth_m)[inside] <= 0.52 * diagonal).all()
    assert judged.log_likelihood() >= math.log(OUTLIERS / MAX_DEPTH) - 1e-6
    assert (judged.survey.visibility >= 0).all()
    assert (judged.survey.visibility <= 1).all()
    expected = judged.survey.expected[judged.answered]
    assert ((expected > 0) & (expected <= MAX_DEPTH)).all()


@settings(max_examples=50)
@given(rows, rows, depths)
def test_nothing_behind_an_opaque_wall_matters(before: NDArray, behind: NDArray, depth: NDArray) -> None:
    """The wall is three voxels thick, so that no ray of the view gets through a corner."""
    T = look_at((-0.3, 0.21, 0.17), (1.0, 0.21, 0.17))
    wall = np.full(3, OPAQUE_VOXEL)
    # Filled up to whole bricks, so that both maps hold the same ones.
    full = np.full(48, -12.0)
    open_, closed = full.copy(), full.copy()
    for row in (open_, closed):
        row[: len(before) + 3] = np.concatenate([before, wall])
    closed[len(before) + 3 :][: len(behind)] = behind[: 48 - len(before) - 3]
    one, two = (judge_view(PoolMap(row_of_voxels(r)), depth, T, SMALL, noise=NOISE) for r in (open_, closed))
    for name in ("near", "far", "visibility", "expected", "likelihood"):
        behind_wall = two.survey.near < (0.3 + (len(before) + 3) * VOXEL)
        np.testing.assert_array_equal(
            getattr(one.survey, name)[behind_wall], getattr(two.survey, name)[behind_wall]
        )
    for tolerance in TOLERANCES:
        np.testing.assert_array_equal(one.accuracy(tolerance).image, two.accuracy(tolerance).image)


def test_a_true_depth_and_what_was_measured_of_it_are_judged_apart(random_map: HandMade) -> None:
    """Tolerances but "sensor" go by the truth, the sensor's by the measurement, pixel by pixel."""
    m = PoolMap(random_map.pool)
    T = VIEWS[0]
    random = np.random.default_rng(5)
    true = random.uniform(0.5, 3.0, CAMERA.shape).astype(np.float32)
    measured = (true + random.normal(0, 0.05, CAMERA.shape)).astype(np.float32)
    measured[random.random(CAMERA.shape) < 0.3] = 0
    both = judge_view(m, true, T, CAMERA, measured_m=measured, noise=NOISE)
    by_truth = judge_view(m, true, T, CAMERA, noise=NOISE)
    by_sensor = judge_view(m, measured, T, CAMERA, noise=NOISE)
    for tolerance in ("voxel", "1.5sigma", "5cm"):
        assert both.accuracy(tolerance).score == by_truth.accuracy(tolerance).score
    assert both.accuracy("sensor").score == by_sensor.accuracy("sensor").score
    assert both.log_likelihood() == pytest.approx(by_sensor.log_likelihood(), rel=1e-6)
    np.testing.assert_array_equal(both.accuracy("sensor").image == NOT_JUDGED, measured == 0)


def test_a_view_without_measurements_still_has_a_truth(random_map: HandMade) -> None:
    depth = np.full(CAMERA.shape, 1.5, np.float32)
    judged = judge_view(
        PoolMap(random_map.pool), depth, VIEWS[0], CAMERA, measured_m=np.zeros(CAMERA.shape), noise=NOISE
    )
    assert 0 <= judged.accuracy("1.5sigma").score <= 1
    assert np.isnan(judged.accuracy("sensor").score)
    assert np.isnan(judged.log_likelihood())


def test_a_view_is_judged_by_a_surface_where_there_is_one() -> None:
    sigma_m, measured_m = 0.03, np.array([[2.02, 2.02, 2.3]], np.float32)
    of_voxels = np.array([[2.05, 2.05, 2.3]], np.float32)
    survey = SurfaceSurvey(
        of_voxels - 0.05, of_voxels + 0.05, np.full((1, 3), 0.5, np.float32), of_voxels, np.full((1, 3), 4.0)
    )
    table = PolynomialNoise((sigma_m,), (0.01,)).table(PinholeCamera(3, 1, 10.0, 10.0, 1.0, 0.0))
    depth_m = np.array([[2.0, 2.0, 2.3]], np.float32)
    judged = JudgedView(depth_m, measured_m, survey, 0.1, 10.0, table)
    surface_m = np.array([[2.001, np.nan, 2.38]], np.float32)
    found = judged.by_surface(surface_m)
    np.testing.assert_allclose(found.answer_m, [[2.001, 2.05, 2.38]], rtol=1e-6)
    assert found.accuracy("voxel").score == pytest.approx(2 / 3)  # half a voxel of 10 cm to each side
    spread = math.hypot(sigma_m, SURFACE_STD * 0.1)
    densities = []
    for z, d in ((2.02, 2.001), (2.3, 2.38)):
        around = math.exp(-0.5 * ((z - d - 0.01) / spread) ** 2) / (math.sqrt(2 * math.pi) * spread)
        densities.append((1 - MISSED) * around + MISSED * (4.0 + 0.5 / 10.0))
    densities.insert(1, 4.0 + 0.5 / 10.0)
    expected = [math.log((1 - OUTLIERS) * each + OUTLIERS / 10.0) for each in densities]
    np.testing.assert_allclose(found.log_densities(), expected, atol=2e-5)  # depths are float32


def test_a_ray_that_leaves_the_map_is_right_if_its_depth_lies_beyond() -> None:
    # Within 1.5 voxels, and not; through and beyond, and short of it; met nothing and beyond; not judged.
    middle = np.array([[2.0, 2.0, 2.0, 2.0, 0.0, 2.0]], np.float32)
    kept = np.array([[0.4, 0.4, 0.6, 0.6, 1.0, 0.0]], np.float32)
    depth_m = np.array([[2.1, 2.2, 3.1, 2.0, 3.1, 0.0]], np.float32)
    half = np.where(middle > 0, np.float32(0.05), np.float32(0))
    survey = SurfaceSurvey(middle - half, middle + half, kept, middle, np.zeros_like(kept))
    table = PolynomialNoise((0.1,)).table(PinholeCamera(6, 1, 10.0, 10.0, 2.5, 0.0))
    judged = JudgedView(depth_m, depth_m, survey, 0.1, 10.0, table)
    assert judged.accuracy("1.5sigma").score == 2 / 5
    assert judged.right_or_beyond(np.full((1, 6), 3.0)) == pytest.approx(3 / 5)
    assert judged.right_or_beyond(np.full((1, 6), 4.0)) == pytest.approx(1 / 5)
    first = judged.only(np.arange(6)[None] == 0)
    assert first.right_or_beyond(np.zeros((1, 6))) == first.accuracy("1.5sigma").score == 1
    assert np.isnan(judged.only(depth_m < 0).right_or_beyond(np.zeros((1, 6))))


@pytest.mark.parametrize("pose", VIEWS)
def test_rays_leave_the_map_where_the_box_of_its_bricks_ends(random_map: HandMade, pose: Pose) -> None:
    found = boundary_depth(PoolMap(random_map.pool), CAMERA, pose)
    lower = random_map.bricks.min(axis=0) * BRICK_M
    upper = (random_map.bricks.max(axis=0) + 1) * BRICK_M
    step = 0.01
    depths = np.arange(step, 12.0, step)
    inside = np.zeros((len(depths), *CAMERA.shape), bool)
    for i, depth in enumerate(depths):
        points = depth * CAMERA.rays() @ pose[:3, :3].T + pose[:3, 3]
        inside[i] = ((points > lower) & (points < upper)).all(axis=-1)
    last = len(depths) - 1 - np.argmax(inside[::-1], axis=0)
    entered = inside.any(axis=0)
    assert entered.any()
    np.testing.assert_allclose(found[entered], depths[last][entered], atol=step)
    assert (found[~entered] > 0).sum() <= 0.1 * (~entered).sum()  # a corner cut by less than a step
    corners = lower + 0.1, upper - 0.1
    assert (boundary_depth(PoolMap(random_map.pool), CAMERA, pose, *corners) <= found).all()


def test_the_boundary_of_a_ray_along_its_face_and_of_no_map() -> None:
    row = PoolMap(row_of_voxels(np.zeros(16)))
    assert boundary_depth(row, SQUARE_ON, row_pose(-0.3)).item() == pytest.approx(1.1)
    assert boundary_depth(row, SQUARE_ON, row_pose(0.5)).item() == pytest.approx(0.3)
    assert boundary_depth(row, SQUARE_ON, row_pose(0.9)).item() == 0
    along_x = np.array([[0, 0, 1, -0.3], [-1, 0, 0, 0.175], [0, -1, 0, 0.175], [0, 0, 0, 1.0]])
    in_a_face = boundary_depth(row, SQUARE_ON, along_x, (0, 0.175, 0), (0.8, 0.4, 0.4))
    assert in_a_face.item() == pytest.approx(1.1)
    assert boundary_depth(PoolMap(BrickPool(-2.2)), SQUARE_ON, row_pose(0.0)).item() == 0
