"""The list of what can be tuned: it names only what there is, and its sliders give what is accepted."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.config.text import differences
from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.tune.knobs import KNOBS, Knob, find_parameter
from taichi_mrf.viewer.tune.panel import config_value, shown_value

SLIDERS = [knob for knob in KNOBS if knob.range is not None]


@pytest.mark.parametrize("knob", KNOBS, ids=lambda knob: knob.name)
def test_every_knob_is_a_parameter_with_help(knob: Knob) -> None:
    assert len(knob.parameter.help) > 20
    value = knob.parameter.value_of(Config())
    assert knob.parameter.replaced(Config(), value) == Config() or knob.parameter.coefficient is not None


def test_no_parameter_is_listed_twice() -> None:
    assert len({knob.name for knob in KNOBS}) == len(KNOBS)


@pytest.mark.parametrize("knob", SLIDERS, ids=lambda knob: knob.name)
def test_both_ends_of_a_slider_are_accepted_and_change_that_parameter_alone(knob: Knob) -> None:
    for end in (knob.range.least, knob.range.most):
        config = knob.parameter.replaced(Config(), config_value(knob, end))
        assert shown_value(knob, config) == pytest.approx(end)
        assert set(differences(Config(), config)) <= {".".join(knob.parameter.path)}


@pytest.mark.parametrize("knob", SLIDERS, ids=lambda knob: knob.name)
def test_the_shipped_default_lies_within_the_slider(knob: Knob) -> None:
    value = knob.parameter.value_of(Config())
    if value is not None:
        within = np.log10(value) if knob.decades else value
        assert knob.range.least <= within <= knob.range.most


@given(st.floats(1e-9, 1.0))
def test_a_slider_of_decades_gives_back_what_it_shows(floor: float) -> None:
    knob = next(each for each in KNOBS if each.name == "inference.outlier_floor")
    config = knob.parameter.replaced(Config(), floor)
    assert config_value(knob, shown_value(knob, config)) == pytest.approx(floor, rel=1e-3)


def test_a_coefficient_beyond_the_polynomial_lengthens_it() -> None:
    config = find_parameter("sensor.bias[2]").replaced(Config(), 0.01)
    assert config.sensor.bias == (0.0, 0.0, 0.01)
    assert find_parameter("sensor.bias[1]").value_of(Config()) == 0.0


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("inference.sweep", "did you mean 'sweeps'"),
        ("inference", "inference is a section"),
        ("voxel_size.x", "voxel_size is no section"),
        ("sensor.sigma", "name one of its coefficients"),
        ("inference.sweeps[0]", "has no coefficients"),
        ("Sweeps!", "no parameter's name"),
    ],
)
def test_a_wrong_name_is_told_in_one_line(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)) as caught:
        find_parameter(name)
    assert "\n" not in str(caught.value)


def test_only_what_changes_something_is_shown() -> None:
    def shown(config: Config) -> set[str]:
        return {knob.name for knob in KNOBS if knob.applies(config)}

    mrf = shown(Config())
    assert {"inference.sweeps", "inference.surface_density", "sensor.sigma[0]"} <= mrf
    assert not {"log_odds.hit", "visibility.hit_if_free", "inference.prior"} & mrf
    with_prior = dataclasses.replace(Config(), inference=InferenceConfig(prior=0.1))
    assert "inference.prior" in shown(with_prior)
    assert "inference.surface_density" not in shown(with_prior)
    assert "log_odds.hit" in shown(Config(method="log_odds"))
    assert "inference.sweeps" not in shown(Config(method="log_odds"))
    table = dataclasses.replace(Config(), sensor=SensorConfig(sigma_table="sigma.npy"))
    assert "sensor.sigma[0]" not in shown(table)
    assert "sensor.bias[0]" in shown(table)
