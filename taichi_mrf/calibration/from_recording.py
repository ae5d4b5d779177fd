"""Sigma learnt from the recording that is to be mapped, without any truth.

Some of its frames are mapped and others held out. The law of sigma under which the held-out measurements are
likeliest takes the place of the assumed one, unless they agree with that, and the map is made again, until
they agree or are no likelier. What the law then holds is not the sensor's noise alone:
poses that are off and errors that neighbouring pixels share are in it, because they make depth differ from a
map as noise does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.config.schema import Config, EvaluationConfig, without_window
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.derived import chosen
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.evaluation.noise_check import checked, explained_frame
from taichi_mrf.evaluation.noise_fit import Explained, SigmaLaw, pooled, sigma_law
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.mapping.result import MappingResult

FRAMES, RUNS, LONGEST_STRIDE = 60, 3, 10
"""Of a long recording so many frames are used, in so many runs; of one run so many frames apart at most,
because frames that are further apart may not see each other's surfaces."""

HOLD_OUT = 4
"""One of so many is held out."""

MAPS = 3
"""Maps that are made, at most."""


@dataclass(frozen=True)
class LearntSigma:
    """The law of sigma over what is stated, and what it was learnt from: held-out ``frames`` with ``pixels``
    measurements, which had wanted ``factor`` times the assumed sigma, and whose mean log density per metre
    rose from ``before`` to ``after``. A noise that they agree with stays as it is."""

    law: SigmaLaw
    frames: int
    pixels: int
    factor: float
    before: float
    after: float

    def put_into(self, config: Config) -> Config:
        """The parameters with the law."""
        return _with_law(config, self.law)


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
    if dataset.tracked or dataset.endless:
        raise ConfigError(
            f"{dataset.name}: --noise auto needs a recording with poses: map it once, then again with "
            "--poses trajectory.txt --noise auto"
        )
    frames = chosen(dataset, _spread(range(0, len(dataset), every)[:limit]))
    trial = replace(without_window(config), color=False, evaluation=EvaluationConfig(hold_out=HOLD_OUT))
    law = SigmaLaw(config.sensor.sigma_scale, config.sensor.sigma_added)
    found: LearntSigma | None = None
    for number in range(1, MAPS + 1):
        on_map(number)
        m = map_sequence(frames, _with_law(trial, law), skip_bad_frames=True, should_stop=should_stop)
        parts = _held_out(m, frames)
        measured = pooled(parts)
        if measured is None:
            raise DatasetError(
                f"{dataset.name}: --noise auto cannot learn: {len(m.held_out)} held-out frames hold too few "
                "measurements; name the noise with --sensor.sigma"
            )
        mean = measured.mean(measured.sigma_m)
        check = checked(measured, len(parts))
        if found is None:
            found = LearntSigma(law, check.frames, check.pixels, check.factor, mean, mean)
        elif mean > found.after:
            found = replace(found, law=law, after=mean)
        else:
            break
        if not check.wrong or should_stop():
            break
        # A sigma that is too large is so without any part of a voxel, too.
        law = sigma_law(measured if check.factor > 1.0 else replace(measured, voxel_m=0.0))
    assert found is not None, "there is at least one map"
    return found


def _spread(indices: range) -> list[int]:
    """FRAMES of the indices at most, in RUNS."""
    if len(indices) <= FRAMES:
        return list(indices)
    each = FRAMES // RUNS
    stride = min(LONGEST_STRIDE, len(indices) // FRAMES)
    starts = np.linspace(0, len(indices) - each * stride, RUNS).astype(int).tolist()
    return [indices[start + k * stride] for start in starts for k in range(each)]


def _with_law(config: Config, law: SigmaLaw) -> Config:
    sensor = replace(config.sensor, sigma_scale=_rounded(law.scale), sigma_added=_rounded(law.added_m))
    return replace(config, sensor=sensor)


def _rounded(value: float) -> float:
    """Rounded to four significant digits, which is all that counts."""
    return float(f"{value:.4g}")


def _held_out(result: MappingResult, frames: Dataset) -> list[Explained]:
    """How well the map explains each frame that was held out."""
    parts = []
    for index in result.held_out:
        try:
            part = explained_frame(result.map, frames.read(index))
        except FrameError:
            part = None
        if part is not None:
            parts.append(part)
    return parts
