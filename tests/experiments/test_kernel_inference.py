"""Kernel inference against its sums over all samples, and samples against what a scan measured."""

import numpy as np
import pytest

from taichi_mrf import FREE, OCCUPIED, UNKNOWN, RayTable
from taichi_mrf.experiments import kernel_inference
from taichi_mrf.experiments.kernel_inference import KernelMap, KernelModel
from taichi_mrf.experiments.scenes import SceneView

pytest.importorskip("scipy", reason="kernel inference needs SciPy, of the extra mesh")


def scan(eye: list[float], ends: np.ndarray) -> SceneView:
    """A scan from a place that measured points (N, 3) of the world."""
    T = np.eye(4)
    T[:3, 3] = eye
    table, range_m = RayTable.of_points(ends - T[:3, 3])
    return SceneView("scan", T, range_m, range_m, range_m > 0, camera=table)


def test_a_cell_counts_all_samples_near_its_centre() -> None:
    rng = np.random.default_rng(0)
    scans = [scan(list(rng.uniform(-0.2, 0.2, 3)), rng.uniform(-1.5, 1.5, (40, 3))) for _ in range(3)]
    model = KernelModel(length_m=0.35, spacing_m=0.2)
    m = KernelMap(model, 0.1, scans)
    points = rng.uniform(-1.6, 1.6, (200, 3))
    centres = (np.floor(points / 0.1) + 0.5) * 0.1
    counts = []
    for of_scans in zip(*(kernel_inference.samples_of(view, model) for view in scans), strict=True):
        d = np.linalg.norm(centres[:, None] - np.concatenate(of_scans), axis=2)
        r = np.minimum(d / 0.35, 1.0)
        k = (2 + np.cos(2 * np.pi * r)) / 3 * (1 - r) + np.sin(2 * np.pi * r) / (2 * np.pi)
        counts.append(0.001 + k.sum(axis=1))
    np.testing.assert_allclose(m.occupancy(points), counts[0] / sum(counts), rtol=1e-5)
    states, weight = m.state(points), sum(counts) - 0.002
    assert (states[weight > 1e-6] != UNKNOWN).all()
    assert (states[weight < 1e-15] == UNKNOWN).all()
    known = states != UNKNOWN
    np.testing.assert_array_equal(states[known] == OCCUPIED, (counts[0] > counts[1])[known])
    assert {OCCUPIED, FREE, UNKNOWN} <= set(states.tolist())


def test_samples_of_a_ray() -> None:
    ends, free = kernel_inference.samples_of(
        scan([0.02, 0.0, 0.0], np.array([[1.34, 0.0, 0.0]])), KernelModel()
    )
    np.testing.assert_allclose(ends, [[1.34, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(np.sort(free[:, 0]), [0.52, 0.84], atol=1e-6)
    np.testing.assert_allclose(free[:, 1:], 0, atol=1e-6)


def test_samples_in_one_cube_are_one() -> None:
    points = np.array([[1.01, 0.01, 0.01], [1.03, 0.05, 0.03], [1.21, 0.0, 0.0]])
    ends, _ = kernel_inference.samples_of(scan([0.0, 0.0, 0.0], points), KernelModel())
    np.testing.assert_allclose(np.sort(ends[:, 0]), [1.02, 1.21], atol=1e-6)


def test_the_kernel_falls_from_one_to_nothing() -> None:
    model = KernelModel(length_m=0.4)
    weights = model.weights(np.linspace(0, 0.4, 50))
    assert weights[0] == 1
    assert abs(weights[-1]) < 1e-12
    assert (np.diff(weights) < 0).all()
