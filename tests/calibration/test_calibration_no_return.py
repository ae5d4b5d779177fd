"""The chance of no return, learnt: the parameters that made the data, and data that cannot tell."""

import numpy as np
import pytest

from taichi_mrf.calibration.no_return import fit_no_return
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.no_return import NoReturnLaw, no_return_chance


@pytest.mark.parametrize("law", [(0.05, 30.0, 4.0), (0.35, 12.0, 1.5), (0.0, 3.0, 0.4)])
def test_the_parameters_are_found_again(law: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(0.5, 1.7 * law[1], 200_000)
    missing = rng.random(true.size) < no_return_chance(true, *law)
    true[::17] = np.resize([0.0, np.nan, np.inf], true[::17].size)  # no surface is known there
    fit = fit_no_return(true, missing)
    assert fit.share == pytest.approx(law[0], abs=0.01)
    assert fit.depth_m == pytest.approx(law[1], rel=0.02)
    assert fit.width_m == pytest.approx(law[2], rel=0.06)
    found = NoReturnLaw.of(SensorConfig(no_return="model", max_depth=1000.0, **fit.fields()))
    assert found is not None
    np.testing.assert_allclose(found.chance(fit.depths_m), fit.chance, atol=0.04)


def test_returns_from_everywhere_put_the_depth_beyond_them() -> None:
    true = np.random.default_rng(1).uniform(1.0, 10.0, 20_000)
    fit = fit_no_return(true, np.zeros(true.size, bool))
    assert no_return_chance(10.0, fit.share, fit.depth_m, fit.width_m) < 0.01


def test_bad_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="true_m holds 4 pixels, no_return 3"):
        fit_no_return(np.ones(4), np.zeros(3, bool))
    with pytest.raises(ConfigError, match="2 pixels have a true depth; no_return needs at least 1000"):
        fit_no_return([1.0, 2.0, 0.0], np.zeros(3, bool))
