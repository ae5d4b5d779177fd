# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.
"""Log-odds and logarithms of probabilities against NumPy's in float64."""

import numpy as np
import pytest

from taichi_mrf.inference.ray_model import log_pass
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, Template
from taichi_mrf.voxels.log_odds import log_let_through

pytestmark = pytest.mark.compilers

LOG_ODDS = np.array([-60.0, -20.0, -9.2, -2.2, -0.1, 0.0, 0.4, 3.0, 9.2, 20.0, 60.0], np.float32)


@ti.kernel
def _let_through(x: F32Array, share: F32, passes: Template, out: F32Array):
    for i in range(x.shape[0]):
        out[i] = log_let_through(x[i], share, passes)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("pass_through", [0.0, 0.02, 0.3, 0.9])
def test_what_a_voxel_lets_through(pass_through: float) -> None:
    out = np.zeros_like(LOG_ODDS)
    _let_through(LOG_ODDS, log_pass(pass_through), pass_through > 0, out)
    runtime.settle()
    occupied = 1 / (1 + np.exp(-LOG_ODDS.astype(np.float64)))
    free = 1 / (1 + np.exp(LOG_ODDS.astype(np.float64)))
    # A float32 near 60, the largest of the log-odds, is right to 4e-6.
    np.testing.assert_allclose(out, np.log(free + pass_through * occupied), rtol=1e-5, atol=4e-6)
