"""The vote of the rays for their first surface: against NumPy ray by ray, and what a reading is."""

import numpy as np
import pytest
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st
from one_pixel import VOXEL, allocated, look_along, marginals
from oracles import inference as reference
from oracles.forward import Noise
from uncertain_wall import WALL_M, uncertain_wall

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import KeyframeError
from taichi_mrf.methods.mrf import decided
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.map_reading import MapReading
from taichi_mrf.queries.cast import cast_rays
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system.compiler import ti

# Written out, and not imported: these tests hold the values.
CALLED, GRAZED = 0.01, 0.1

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]


def vote(ray: reference.Ray, p: dict, learnt: float, floor: float, votes: dict) -> bool:
    """Add one ray's votes; False if rounding may decide what they are."""
    visibility, explained, found = 1.0, 0.0, []
    for segment, density in zip(ray.segments, ray.densities, strict=True):
        if segment.voxel in p:
            free = (1 - p[segment.voxel]) ** segment.length
            here = (1 - free) * density * visibility
            explained += here
            found.append((segment, here if p[segment.voxel] > learnt else 0.0))
            visibility *= free
            if segment.length < 0.01 or abs(p[segment.voxel] - learnt) < 1e-4:
                return False
    best = sorted((here for _, here in found), reverse=True)[:2]
    if len(best) < 2 or best[1] > 0.99 * best[0] or abs(explained / floor - 1) < 0.01:
        return False
    if explained > floor:
        front = [here for _, here in found].index(best[0])
        if any(abs(segment.length - GRAZED) < 0.01 for segment, _ in found[:front]):
            return False
        for segment, _ in found[:front]:
            if segment.length > GRAZED:
                votes[segment.voxel] = votes.get(segment.voxel, 0) - 2
        votes[found[front][0].voxel] = votes.get(found[front][0].voxel, 0) + 3
    return True


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 3), sigma=st.floats(0.05, 0.2))
def test_voxels_are_called_as_the_rays_vote(seed: int, count: int, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(3, 2, 8.0, 8.0, 1.0, 0.5)
    config = InferenceConfig(outlier_floor=1e-3, ray_density=0.0)
    m = MRFMap(VOXEL, PolynomialNoise((sigma,)), inference=config, max_depth=1.5)
    rays = []
    middle = rng.uniform(-1, 1, 3)
    for _ in range(count):
        direction = rng.normal(size=3)
        T = look_along(middle - 0.6 * direction / np.linalg.norm(direction), direction, rng)
        depth = rng.uniform(0.5, 0.7, camera.shape).astype(np.float32)
        m.add_keyframe(depth, T, camera)
        rays += reference.cast(depth, T, camera, VOXEL, Noise((sigma,)), max_depth=1.5)
    m.infer()
    voxels = sorted(allocated(m))
    before = marginals(m, voxels)
    p = dict(zip(voxels, before.tolist(), strict=True))
    learnt = reference.logistic(reference.logit(m.prior) + m.config.volume.min_evidence)
    votes: dict[reference.Voxel, int] = {}
    doubtful: set[reference.Voxel] = set()
    for ray in rays:
        if not vote(ray, p, learnt, config.floor, votes):
            doubtful |= {s.voxel for s in ray.segments}
    assume(len(doubtful) < len(voxels))
    called = reference.logistic(CALLED)
    expected = {v: max(p[v], called) if votes.get(v, 0) > 0 else p[v] for v in voxels if v not in doubtful}
    got = marginals(MapReading(m, m._parts, m._parts.decisions.log_odds(settled=True)), list(expected))
    np.testing.assert_allclose(got, list(expected.values()), atol=1e-5)
    np.testing.assert_array_equal(marginals(m.layer(), voxels), before)
    sure = [v for v in voxels if v not in doubtful]
    counted = ti.ndarray(ti.f32, m.view.pool.belief.shape)
    counted.from_numpy(m._parts.decisions._votes.to_numpy().reshape(-1, 2)[:, 0].astype(np.float32) / 4)
    found = [4 * reference.logit(p) for p in marginals(MapReading(m, m._parts, counted), sure).tolist()]
    np.testing.assert_allclose(found, [votes.get(v, 0) for v in sure], atol=1e-3)
    event(f"{sum(votes.get(v, 0) > 0 for v in expected)} voxels called")


def test_a_wall_that_no_voxel_is_sure_of_stops_rays() -> None:
    m = uncertain_wall()
    straight = np.linspace(-0.3, 0.5, 9)[:, None] * [1, 0, 0] + [0.003, 0.02, 0]
    assert not cast_rays(m.layer(), straight, (0, 0, 1), 3.0).hit.any()
    surface = m.decided
    found = cast_rays(m, straight, (0, 0, 1), 3.0)
    assert found.hit.mean() > 0.8
    np.testing.assert_allclose(found.range[found.hit] + VOXEL / 2, WALL_M, atol=2.5 * VOXEL)
    called = found.point[found.hit] + [0, 0, VOXEL / 2]
    assert (m.state(called) == OCCUPIED).all()
    np.testing.assert_array_equal(surface.state(called), m.state(called))
    assert len(surface.marginals.voxels()[0]) > len(m.marginals.voxels()[0])


def test_what_marginals_call_occupied_stays_so() -> None:
    m = uncertain_wall()
    centres, _ = m.voxels(0.0)
    before, after = m.layer().state(centres), m.decided.state(centres)
    assert (after[before == OCCUPIED] == OCCUPIED).all()
    assert (before != OCCUPIED)[after == OCCUPIED].any()
    np.testing.assert_array_equal(after[after != OCCUPIED], before[after != OCCUPIED])


def test_what_is_occupied_shows_calibrated_probabilities_as_far_as_its_state_allows() -> None:
    m = uncertain_wall()
    centres, marginal = m.voxels(0.0)
    state, shown, likely = m.state(centres), m.decided.occupancy(centres), m.calibrated().occupancy(centres)
    occupied, free = state == OCCUPIED, state == FREE
    np.testing.assert_allclose(
        shown[occupied], np.maximum(likely[occupied], reference.logistic(CALLED)), atol=1e-5
    )
    assert shown[occupied].max() > 0.6
    assert (shown[free] <= likely[free] + 1e-6).all()
    unseen = marginal == marginal[np.abs(marginal - m.prior).argmin()]
    np.testing.assert_array_equal(shown[unseen], marginal[unseen])


def test_a_reading_follows_edits() -> None:
    edited, plain = uncertain_wall(3), uncertain_wall(2)
    reading = edited.decided
    edited.remove_keyframe(2)
    with pytest.raises(KeyframeError, match="has changed since it was read"):
        reading.occupancy(np.zeros((1, 3)))
    edited.infer()
    centres, _ = plain.voxels(0.0)
    np.testing.assert_array_equal(edited.decided.occupancy(centres), plain.decided.occupancy(centres))


def test_a_new_keyframe_adds_its_votes_to_those_of_before() -> None:
    m, scene = uncertain_wall(2), uncertain_wall(3)
    third = scene.keyframes[2]
    before = int(m.first_surfaces().sum())
    m.add_keyframe(third.depth_m, third.T_world_camera, third.camera)
    m.renew()
    followed = m.decided
    assert m.first_surfaces().sum() != before
    centres, _ = scene.voxels(0.0)
    same = followed.state(centres) == scene.decided.state(centres)
    assert same.mean() > 0.97  # votes of the first two are those of before
    m.infer()
    np.testing.assert_array_equal(m.decided.occupancy(centres), scene.decided.occupancy(centres))


def test_keyframes_counted_together_vote_as_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    together = uncertain_wall(3)
    together.decide(lambda: calls.append(1))
    assert len(calls) == 6  # votes and distances of each
    monkeypatch.setattr(decided, "AT_ONCE", 1)
    alone = uncertain_wall(3)
    assert together.first_surfaces().any()
    np.testing.assert_array_equal(together.first_surfaces(), alone.first_surfaces())


def test_votes_states_and_the_surface_count_as_memory() -> None:
    m = uncertain_wall(2)
    before = m.statistics().memory_mb
    m.first_surfaces()
    counted = m.statistics().memory_mb
    assert round(1e6 * (counted - before)) >= 4 * 512 * (m.view.pool.capacity - 1)
    m.decide()
    decided = m.statistics().memory_mb
    assert decided - counted >= 4e-6 * 512 * m.view.pool.capacity
    m.render_depth(next(iter(m.keyframes.values())).camera, np.eye(4))
    assert m.statistics().memory_mb > decided


def test_an_empty_map_can_be_read() -> None:
    m = MRFMap(VOXEL)
    assert len(m.decided.voxels()[0]) == 0
