"""The automatic search: which parameters to try next, so that a score of the held-out views improves.

The search itself is Optuna's tree-structured Parzen estimator (Bergstra et al., NIPS 2011), which comes with
the extra ``auto``. By default it maximises the log-likelihood of the held-out measurements under map and
noise together: a sigma that is too small makes measured values improbable, one that is too large spreads the
density.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from taichi_mrf.config.method import Range
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.system.libraries import library
from taichi_mrf.viewer.tune.knobs import KNOBS, Knob
from taichi_mrf.viewer.tune.messages import Objective, headline

SIGMA_SCALE = "sensor.sigma_scale"
"""The factor on every stated sigma. The page has no slider for it: it shows the coefficients themselves."""

SIGMA_SCALES = Range(0.25, 16.0, 0.0)

DEFAULT_SEARCH = (*(knob.name for knob in KNOBS if knob.searched), SIGMA_SCALE)
"""The default search: parameters that depend on the sensor and the scene rather than on the map's purpose."""

Scalar = float | int | str | bool


@dataclass(frozen=True)
class Dimension:
    """One parameter to search, and where: a range, by factors if ``log``, or some choices."""

    name: str
    least: float = 0.0
    most: float = 0.0
    log: bool = False
    whole: bool = False
    choices: tuple[Scalar, ...] = ()


def dimensions(names: Sequence[str], start: Config) -> list[Dimension]:
    """The search space of some parameters.

    Raises ConfigError for a name that cannot be searched, and for a parameter that changes nothing under
    the configuration ``start``.
    """
    if not names:
        raise ConfigError("--search needs at least one parameter")
    return [_dimension(name, start) for name in dict.fromkeys(names)]


class Search:
    """A search of ``tries`` steps: :meth:`ask` for parameters, try them, :meth:`tell` the score.

    ``told`` counts the steps that were made, ``best`` is what did best among them, None before the first.
    It looks at every ``pixel_stride``-th pixel, 0 for as many as a first look.
    """

    def __init__(
        self,
        start: Config,
        names: Sequence[str],
        tries: int,
        seed: int,
        pixel_stride: int = 0,
        objective: Objective = "fit",
    ) -> None:
        """Without ``names`` it searches those default ones that count under ``start``, which itself is the
        first try, so that the best is never worse. Raises ConfigError for names that cannot be searched, and
        if Optuna is not installed."""
        self.start, self.tries, self.told, self.pixel_stride = start, tries, 0, pixel_stride
        self.best: Config | None = None
        names = names or [n for n in DEFAULT_SEARCH if n == SIGMA_SCALE or _knob(n).applies(start)]
        self._dimensions = dimensions(names, start)
        self.objective, self._best_value = headline("voxel_size" not in names)[objective], math.nan
        optuna: Any = library("optuna", "--auto needs", "auto", ConfigError)
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._failed = optuna.trial.TrialState.FAIL
        self._study = optuna.create_study(
            direction="maximize" if self.objective.better == "higher" else "minimize",
            sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True),
        )
        self._study.enqueue_trial({each.name: _value_of(start, each) for each in self._dimensions})
        self._asked: tuple[Any, Config] | None = None

    @property
    def done(self) -> bool:
        """True if all tries were made."""
        return self.told >= self.tries

    def ask(self) -> Config:
        """Configuration to try next; the same until :meth:`tell`."""
        while self._asked is None:
            trial = self._study.ask()
            config = self.start
            try:
                for each in self._dimensions:
                    config = _with_value(config, each, _suggest(trial, each))
            except ConfigError:  # parameters that each are in range may contradict each other
                self._study.tell(trial, state=self._failed)
            else:
                self._asked = trial, config
        return self._asked[1]

    def tell(self, value: float) -> None:
        """The objective's value for the last parameters; NaN if they could not be mapped or judged."""
        assert self._asked is not None
        (trial, config), self._asked = self._asked, None
        self.told += 1
        if math.isfinite(value):
            self._study.tell(trial, value)
            better = (
                value > self._best_value if self.objective.better == "higher" else value < self._best_value
            )
            if self.best is None or better:
                self.best, self._best_value = config, value
        else:
            self._study.tell(trial, state=self._failed)


def _dimension(name: str, start: Config) -> Dimension:
    if name == SIGMA_SCALE:
        return Dimension(name, SIGMA_SCALES.least, SIGMA_SCALES.most, log=True)
    knob = _knob(name)
    if not knob.applies(start):
        raise ConfigError(f"--search {name}: changes nothing with the other parameters as they are")
    if knob.range is None:
        return Dimension(name, choices=_choices(knob))
    least, most = knob.range.least, knob.range.most
    if knob.decades:
        return Dimension(name, 10.0**least, 10.0**most, log=True)
    whole = knob.parameter.hint is int
    return Dimension(name, least, most, log=knob.by_factors, whole=whole)


def _knob(name: str) -> Knob:
    knob = next((each for each in KNOBS if each.name == name), None)
    if knob is None:
        known = ", ".join([each.name for each in KNOBS] + [SIGMA_SCALE])
        raise ConfigError(f"--search {name}: cannot be searched; those that can be are: {known}")
    return knob


def _choices(knob: Knob) -> tuple[Scalar, ...]:
    if get_origin(knob.parameter.hint) is Literal:
        return get_args(knob.parameter.hint)
    return False, True


def _suggest(trial: Any, dimension: Dimension) -> Scalar:
    if dimension.choices:
        chosen: Scalar = trial.suggest_categorical(dimension.name, dimension.choices)
    elif dimension.whole:
        chosen = trial.suggest_int(dimension.name, int(dimension.least), int(dimension.most))
    else:
        value = trial.suggest_float(dimension.name, dimension.least, dimension.most, log=dimension.log)
        chosen = float(f"{value:.4g}")  # more digits count for nothing
    return chosen


def _value_of(config: Config, dimension: Dimension) -> Scalar:
    """The start value of a parameter, clipped to its range."""
    scale = dimension.name == SIGMA_SCALE
    value: Scalar = config.sensor.sigma_scale if scale else _knob(dimension.name).parameter.value_of(config)
    if dimension.choices:
        return value
    within = min(max(float(value), dimension.least), dimension.most)
    return int(within) if dimension.whole else within


def _with_value(config: Config, dimension: Dimension, value: Scalar) -> Config:
    if dimension.name == SIGMA_SCALE:
        sensor = dataclasses.replace(config.sensor, sigma_scale=float(value))
        return dataclasses.replace(config, sensor=sensor)
    return _knob(dimension.name).parameter.replaced(config, value)
