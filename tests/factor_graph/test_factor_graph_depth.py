"""Depth keyframes as a factor graph with a factor for each ray, against enumeration and against MRFMap."""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from one_pixel import VOXEL, crossing, marginals
from oracles import inference as reference
from oracles.forward import Noise

from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.factor_graph.beams import BrickCells
from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.factor_graph.solve import solve
from taichi_mrf.inference.schedule import content_key
from taichi_mrf.methods.mrf.map import MRFMap

pytestmark = pytest.mark.usefixtures("backend")

seeds = st.integers(0, 2**32 - 1)
shallow = st.floats(0.3, 0.7)
CONVERGED = {"iterations": 60, "damping": 0.0, "tolerance": 0.0, "schedule": "parallel", "polish": 0}


def at_voxels(graph: FactorGraph, values: np.ndarray, voxels: list[reference.Voxel]) -> np.ndarray:
    """Of the graph's cells those that are these voxels."""
    assert isinstance(graph.grid, BrickCells)
    number = {tuple(v): i for i, v in enumerate(np.floor(graph.grid.centres() / VOXEL).astype(int).tolist())}
    return values[[number[v] for v in voxels]]


@settings(max_examples=12, suppress_health_check=[HealthCheck.filter_too_much])
@given(seed=seeds, depths=st.tuples(shallow, shallow), sigma=st.floats(0.25, 0.6), prior=st.floats(0.02, 0.6))
def test_sum_product_on_a_tree_of_rays_is_exact(
    seed: int, depths: tuple[float, float], sigma: float, prior: float
) -> None:
    m, rays, config = crossing(seed, depths, sigma, prior)
    common = {s.voxel for s in rays[0].segments} & {s.voxel for s in rays[1].segments}
    assume(len(common) == 1)
    graph = m.factor_graph()
    found = solve(graph, LaserConfig(method="bp", **CONVERGED)).marginals  # type: ignore[arg-type]
    assert found is not None
    exact = reference.enumerate_marginals(rays, prior, config.floor)
    np.testing.assert_allclose(at_voxels(graph, found, list(exact)), list(exact.values()), atol=1e-4)
    untouched = np.ones(len(found), bool)
    untouched[np.isin(np.arange(len(found)), at_voxels(graph, np.arange(len(found)), list(exact)))] = False
    np.testing.assert_allclose(found[untouched], prior, atol=1e-5)


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=20, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=seeds, depths=st.tuples(shallow, shallow, shallow), sigma=st.floats(0.25, 0.6),
    prior=st.floats(0.05, 0.45), method=st.sampled_from(["max-product", "dd", "dd-block", "mh"]),
)  # fmt: skip
def test_energies_are_those_of_the_joint_distribution_and_bounds_bound_them(
    seed: int, depths: tuple[float, ...], sigma: float, prior: float, method: str
) -> None:
    m, rays, config = crossing(seed, depths, sigma, prior)
    voxels = sorted({s.voxel for ray in rays for s in ray.segments})
    assume(len(voxels) <= 14)
    graph = m.factor_graph()
    laser = LaserConfig(method=method, iterations=80, step=2.0)  # type: ignore[arg-type]
    found = solve(graph, laser)
    states = (np.arange(2 ** len(voxels))[:, None] >> np.arange(len(voxels))) & 1
    column = {v: i for i, v in enumerate(voxels)}
    energies = np.where(states == 1, -np.log(prior), -np.log1p(-prior)).sum(axis=1)
    for ray in rays:
        factor = np.full(len(states), ray.beyond)
        for segment, density in zip(reversed(ray.segments), reversed(ray.densities), strict=True):
            factor = np.where(states[:, column[segment.voxel]] == 1, density, factor)
        energies -= np.log(factor + config.floor)
    energies += (graph.grid.cells - len(voxels)) * -np.log1p(-prior)
    labels = at_voxels(graph, found.labels, voxels)
    index = int((labels * 2 ** np.arange(len(voxels))).sum())
    beside = int(found.labels.sum()) - int(labels.sum())  # sampling leaves some that no ray crosses
    rounding = 1e-3 + graph.beams / 8192  # energies are counted in 4096ths, for each factor
    expected = energies[index] + beside * np.log((1 - prior) / prior)
    assert found.energy == pytest.approx(expected, abs=rounding)
    assert found.energy >= energies.min() - rounding
    if found.dual is not None:
        assert found.dual <= energies.min() + rounding


@pytest.mark.usefixtures("one_backend")
@settings(max_examples=8, suppress_health_check=[HealthCheck.filter_too_much])
@given(seed=seeds, depths=st.lists(shallow, min_size=3, max_size=5))
def test_with_one_ray_in_each_keyframe_the_map_is_the_graphs(seed: int, depths: list[float]) -> None:
    """An average of one message is that message, so the approximation is none."""
    m, rays, _ = crossing(seed, tuple(depths), 0.3, 0.2)
    graph = m.factor_graph()
    voxels = sorted({s.voxel for ray in rays for s in ray.segments})
    report = m.infer(sweeps=60)
    assume(report.residual == 0)
    found = solve(graph, LaserConfig(method="bp", **CONVERGED)).marginals  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(at_voxels(graph, found, voxels), marginals(m, voxels), atol=2e-3)


def room_map(**parameters: object) -> MRFMap:
    """Three small views of the built-in room."""
    m = MRFMap(0.1, **parameters)  # type: ignore[arg-type]
    for frame in open_dataset("synthetic:room?frames=3&width=40&height=30"):
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera)
    return m


def test_every_second_pixel_is_a_quarter_of_the_rays_and_each_voxel_has_its_prior() -> None:
    m = room_map()
    whole, part = m.factor_graph(), m.factor_graph(every=2)
    assert whole.grid.cells == part.grid.cells
    rays = sum(k.rays for k in m.keyframes.values())
    assert whole.beams - whole.grid.cells == rays
    chosen = sum(int((k.depth_m[::2, ::2] > 0).sum()) for k in m.keyframes.values())
    assert part.beams - part.grid.cells == chosen
    assert (whole.degrees.to_numpy() >= 1).all()
    begins, cells = whole.begins.to_numpy(), whole.cells.to_numpy()
    assert begins[-1] == whole.edges == len(cells)
    np.testing.assert_array_equal(cells[whole.edges - whole.grid.cells :], np.arange(whole.grid.cells))
    assert np.diff(begins).max() == whole.longest


def test_what_a_ray_crosses_is_what_the_oracle_crosses() -> None:
    m = room_map()
    graph = m.factor_graph()
    assert isinstance(graph.grid, BrickCells)
    voxels = np.floor(graph.grid.centres() / m.voxel_size).astype(int)
    begins, cells = graph.begins.to_numpy(), graph.cells.to_numpy()
    noise = Noise(m.sensor.sigma, m.sensor.bias)
    keyframes = sorted(m.keyframes.values(), key=content_key)
    f = same = 0
    existing = {tuple(v) for v in voxels.tolist()}
    for keyframe in keyframes:
        cast = reference.cast(
            keyframe.depth_m, keyframe.T_world_camera, keyframe.camera, m.voxel_size, noise,
            m.sensor.max_depth,
        )  # fmt: skip
        for ray in cast:
            wanted = [s.voxel for s in ray.segments if s.voxel in existing]
            same += [tuple(v) for v in voxels[cells[begins[f] : begins[f + 1]]].tolist()] == wanted
            f += 1
    assert f == graph.beams - graph.grid.cells
    assert same > 0.97 * f  # the others graze a corner, which float32 may take the other way round


def test_a_graph_that_does_not_fit_is_refused_with_its_size() -> None:
    m = room_map()
    with pytest.raises(CapacityError, match=r"beams.*edges would need 0\.\d+ GB.*fewer keyframes or pixels"):
        m.factor_graph(memory_limit_gb=0.001)
    with pytest.raises(ConfigError, match="every"):
        m.factor_graph(every=0)


@pytest.mark.parametrize(
    ("method", "start"), [("inverse", "random"), ("mh-heat", "random"), ("mh", "inverse")]
)
def test_methods_that_need_the_ends_of_beams_are_refused(method: str, start: str) -> None:
    graph = room_map().factor_graph(every=4)
    with pytest.raises(ConfigError, match="end where they measured"):
        solve(graph, LaserConfig(method=method, start=start))  # type: ignore[arg-type]


def test_frozen_keyframes_are_the_prior_of_the_graph() -> None:
    m = room_map()
    m.infer()
    first = next(iter(m.keyframes))
    m.freeze_keyframe(first)
    graph = m.factor_graph(every=4)
    assert isinstance(graph.grid, BrickCells)
    table, rays = graph.model.to_numpy()[:, 0], graph.beams - graph.grid.cells
    entries = graph.begins.to_numpy()[rays:-1] + np.arange(rays, graph.beams)
    prior = 1 / (1 + np.exp(table[entries] - table[entries + 1]))
    assert prior.std() > 0.01
    for other in list(m.keyframes):
        m.remove_keyframe(other)
    m.infer()
    centres, known = m.voxels(0.0)
    voxels = [tuple(v) for v in np.floor(centres / VOXEL).astype(int).tolist()]
    assert m.voxel_size == VOXEL
    assert len(voxels) > 1000
    np.testing.assert_allclose(at_voxels(graph, prior, voxels), known, atol=1e-5)


def test_a_map_answers_with_what_it_has_adopted_until_it_infers_again() -> None:
    m = room_map()
    m.infer()
    before, _ = m.marginals.voxels(0.5)
    graph = m.factor_graph()
    assert isinstance(graph.grid, BrickCells)
    centres = graph.grid.centres()
    log_odds = np.random.default_rng(0).normal(0, 3, graph.grid.cells).astype(np.float32)
    m.adopt(log_odds)
    np.testing.assert_allclose(m.marginals.occupancy(centres), 1 / (1 + np.exp(-log_odds)), atol=1e-5)
    m.infer()
    np.testing.assert_array_equal(m.marginals.voxels(0.5)[0], before)
