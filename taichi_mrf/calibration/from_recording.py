"""Sigma learnt from the recording that is to be mapped, without any truth.

Some of its frames are mapped and others held out. The law of sigma under which the held-out measurements are
likeliest takes the place of the assumed one, unless they agree with that, and the map is made again, until
they agree or are no likelier. What the law then holds is not the sensor's noise alone:
poses that are off and errors that neighbouring pixels share are in it, because they make depth differ from a
map as noise does.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config, EvaluationConfig, SensorConfig, without_window
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.derived import chosen
from taichi_mrf.datasets.recorded_noise import LONG_RAY
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.evaluation.noise_fit import Explained, SigmaLaw, checked, explained_frame, pooled
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.mapping.result import MappingResult

FRAMES, RUNS, LONGEST_STRIDE = 60, 3, 10
"""Of a long recording so many frames are used, in so many runs; of one run so many frames apart at most,
because frames that are further apart may not see each other's surfaces."""

GLANCE, GLANCE_RUNS = 16, 2
"""The default noise is checked, and learnt, by so many frames, in so many runs,"""

GLANCE_COST = 4
"""of a recording that has at least so many times as many. In a recording of half as many a stated noise is
checked, too,"""

FAR_OFF = 3.0
"""and replaced if it is that many times too small."""

NOISE = ("sigma", "bias", "sigma_table", "bias_table", "patch", "pixel_sigma", "sigma_scale", "sigma_added")
"""The parameters of noise among those of the sensor."""

HOLD_OUT = 4
"""One of so many is held out."""

MAPS, MOST_MAPS = 3, 5
"""Maps that are made for the law, and with those for the prior, at most."""

WILD = 1e-2
"""Density of outliers per metre that is tried, too, where rays are long (LONG_RAY), as outdoors, with a prior
of one surface in the mean length of a ray. A prior that expects few surfaces cannot explain outliers
otherwise."""

LEAST_GAIN = 0.1
"""Nats by which each held-out measurement must be likelier for a prior to take the place of the given one."""


@dataclass(frozen=True)
class LearntSigma:
    """The law of sigma over what is stated, and what it was learnt from: held-out ``frames`` with ``pixels``
    measurements, which had wanted ``factor`` times the assumed sigma, and whose mean log density per metre
    rose from ``before`` to ``after``. A noise that they agree with stays as it is. ``prior`` are the
    parameters of inference that were changed with it, by name; empty for most recordings. It took some
    ``seconds``."""

    law: SigmaLaw
    frames: int
    pixels: int
    factor: float
    before: float
    after: float
    prior: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    def put_into(self, config: Config) -> Config:
        """The parameters with what was learnt."""
        return _with(config, self.law, self.prior)


def learn_sigma(
    dataset: Dataset,
    config: Config,
    *,
    every: int = 1,
    limit: int | None = None,
    on_map: Callable[[int], None] = lambda number: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> LearntSigma:
    """Learn sigma from the frames 0, ``every``, 2 ``every``, ... of a dataset, ``limit`` of them at most.

    ``config`` are the parameters that it will be mapped with; the map may be of any method. ``on_map`` is
    called before each map with its number from 1, ``should_stop`` between keyframes.
    Raises ConfigError for a dataset whose poses are not known or that never ends, DatasetError if the
    held-out frames do not tell, and what mapping raises.
    """
    if dataset.endless:
        raise ConfigError(
            f"--noise auto needs a recording, and {dataset.name} is a live camera: record it, learn with "
            "taichi-mrf map RECORDING --out DIR --noise auto, and pass --config DIR/sensor.yaml"
        )
    if dataset.tracked:
        raise ConfigError(
            f"{dataset.name}: --noise auto needs a recording with poses: map it once, then again with "
            "--poses trajectory.txt --noise auto"
        )
    frames = chosen(dataset, _spread(range(0, len(dataset), every)[:limit]))
    begin, trial = time.perf_counter(), _trial(config)
    numbers = itertools.count(1)

    def measured_with(law: SigmaLaw, prior: dict[str, float]) -> tuple[Explained, int]:
        """The held-out measurements in a map of the others, and the number of frames that they are of."""
        on_map(next(numbers))
        changed = _with(trial, law, prior)
        result = map_sequence(frames, changed, skip_bad_frames=True, should_stop=should_stop)
        parts = _held_out(result, frames)
        measured = pooled(parts)
        if measured is None:
            raise DatasetError(
                f"{dataset.name}: --noise auto cannot learn: {len(result.held_out)} held-out frames hold too "
                "few measurements; name the noise with --sensor.sigma"
            )
        return measured, len(parts)

    law, prior = SigmaLaw(config.sensor.sigma_scale, config.sensor.sigma_added), dict[str, float]()
    measured, count = measured_with(law, prior)
    before = after = measured.mean(measured.sigma_m)
    # The prior first: a sigma that makes up for a wrong one would be too large with the right one.
    least = before + LEAST_GAIN
    for other in [] if should_stop() else _priors(frames, config):
        tried, _ = measured_with(law, other)
        if tried.mean(tried.sigma_m) > least:
            measured, prior, least = tried, other, tried.mean(tried.sigma_m)
            after = least
    first = check = checked(measured, count)
    for _ in range(MAPS - 1):
        better = check.law
        if better is None or should_stop():
            break
        measured, count = measured_with(better, prior)
        mean, check = measured.mean(measured.sigma_m), checked(measured, count)
        if mean <= after:
            break
        law, after = better, mean
    seconds = time.perf_counter() - begin
    return LearntSigma(law, first.frames, first.pixels, first.factor, before, after, prior, seconds)


def sigma_of_glance(
    dataset: Dataset,
    config: Config,
    *,
    every: int = 1,
    limit: int | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> LearntSigma | None:
    """The law of sigma that takes the place of the present one, if held-out frames contradict that: what maps
    of GLANCE of the frames 0, ``every``, 2 ``every``, ..., ``limit`` of them at most, say. A stated noise is
    replaced only if it is far too small. None if they agree; if poses are not known; if frames have a noise
    of their own; if the default's rays are so long that a law needs another prior, too; or if there are so
    few frames that it would cost too much."""
    indices = range(0, len(dataset), every)[:limit] if not dataset.endless else range(0)
    default = is_default_noise(dataset, config.sensor)
    count = min(GLANCE, len(indices) // GLANCE_COST)
    too_few = count < (GLANCE if default else GLANCE // 2)
    if too_few or dataset.tracked or METHODS[config.method].section != "inference":
        return None
    begin, frames = time.perf_counter(), chosen(dataset, _spread(indices, count, GLANCE_RUNS))
    if default and _priors(frames, config):
        return None
    result = map_sequence(frames, _trial(config), skip_bad_frames=True, should_stop=should_stop)
    if any(keyframe.own.noise is not None for keyframe in result.map.keyframes.values()):
        return None
    parts = _held_out(result, frames)
    measured = pooled(parts)
    check = None if measured is None else checked(measured, len(parts))
    if measured is None or check is None or check.law is None:
        return None
    if not default:
        return learn_sigma(frames, config, should_stop=should_stop) if check.factor > FAR_OFF else None
    before, after = measured.mean(measured.sigma_m), measured.under(check.law)
    seconds = time.perf_counter() - begin
    return LearntSigma(check.law, check.frames, check.pixels, check.factor, before, after, seconds=seconds)


def is_default_noise(dataset: Dataset, sensor: SensorConfig) -> bool:
    """True if neither the parameters nor the recording say anything of noise."""
    own, default = dataset.stated.sigma is not None or dataset.stated.pixel_sigma, SensorConfig()
    return not own and all(getattr(sensor, name) == getattr(default, name) for name in NOISE)


def _priors(frames: Dataset, config: Config) -> list[dict[str, float]]:
    """The priors to try beside the given one: none but where rays are long."""
    lengths_m = []
    for index in range(len(frames)):
        try:
            depth_m = frames.read(index).depth_m
        except FrameError:
            continue
        lengths_m.append(np.minimum(depth_m[depth_m > 0], config.sensor.max_depth))
    density = 1.0 / float(np.concatenate(lengths_m).mean())
    given = config.inference
    if (
        METHODS[config.method].section != "inference"
        or given.prior is not None
        or density * LONG_RAY > given.surface_density
    ):
        return []
    few = {"surface_density": _rounded(density)}
    return [few, few | {"outlier_floor": max(WILD, given.floor)}]


def _trial(config: Config) -> Config:
    """The parameters of a map that is made to learn from it."""
    return replace(without_window(config), color=False, evaluation=EvaluationConfig(hold_out=HOLD_OUT))


def _spread(indices: range, most: int = FRAMES, runs: int = RUNS) -> list[int]:
    """``most`` of the indices at most, in some runs."""
    if len(indices) <= most:
        return list(indices)
    each = most // runs
    stride = min(LONGEST_STRIDE, len(indices) // most)
    starts = np.linspace(0, len(indices) - each * stride, runs).astype(int).tolist()
    return [indices[start + k * stride] for start in starts for k in range(each)]


def _with(config: Config, law: SigmaLaw, prior: dict[str, Any]) -> Config:
    sensor = replace(config.sensor, sigma_scale=_rounded(law.scale), sigma_added=_rounded(law.added_m))
    changed: dict[str, Any] = {"sensor": sensor}
    if prior:
        changed["inference"] = replace(config.inference, **prior)
    return replace(config, **changed)


def _rounded(value: float) -> float:
    """Rounded to four significant digits, which is all that counts."""
    return float(f"{value:.4g}")


def _held_out(result: MappingResult, frames: Dataset) -> list[Explained]:
    """Fit of the map to each held-out frame."""
    parts = []
    for index in result.held_out:
        try:
            part = explained_frame(result.map, frames.read(index))
        except FrameError:
            part = None
        if part is not None:
            parts.append(part)
    return parts
