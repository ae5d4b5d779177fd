"""Learning the chance that a surface gives no return (sensor/no_return.py) from pixels of known true depth.

The three parameters are those under which the returns and the missing returns are likeliest. The likelihood
is that of a yes or no for each pixel; pixels of about the same depth are counted together.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.calibration.pairs import PairSource
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.no_return import no_return_chance

BINS = 60
"""Of equally many pixels each."""

LEAST_PIXELS = 1000
PIXELS_OF_AN_IMAGE = 20_000
"""More of one image tell hardly more."""

LARGEST_SHARE = 0.49
"""The configuration's share lies below 0.5."""

_STEPS, _ROUNDS = 9, 14
"""Values of each parameter that are tried, and how often the range around the best is halved."""


@dataclass(frozen=True)
class NoReturnFit:
    """The parameters of q(d), and what they were fitted to: ``chance`` (n,) is the share of missing returns
    among the pixels around each of the depths ``depths_m`` (n,)."""

    share: float
    depth_m: float
    width_m: float
    depths_m: NDArray[np.float64]
    chance: NDArray[np.float64]

    def fields(self) -> dict[str, float]:
        """The parameters as fields of SensorConfig."""
        return {
            "no_return_share": self.share,
            "no_return_depth": self.depth_m,
            "no_return_width": self.width_m,
        }


def learn_no_return(source: PairSource) -> NoReturnFit:
    """Fit q to pairs of measured and true depth: a pixel with a true depth and no measured one got no return.
    Raises DatasetError, ConfigError."""
    true, missing = [], []
    for name in source.names:
        pair = source.read(name)
        known = pair.true_m > 0
        some = slice(None, None, max(1, int(known.sum()) // PIXELS_OF_AN_IMAGE))
        true.append(pair.true_m[known][some])
        missing.append(pair.measured_m[known][some] <= 0)
    return fit_no_return(np.concatenate(true), np.concatenate(missing))


def fit_no_return(true_m: ArrayLike, no_return: ArrayLike) -> NoReturnFit:
    """Fit q to pixels of known true depth (N,), in metres, of which ``no_return`` (N,) says whether they got
    no return. Pixels without a true depth (0, NaN, infinite) are left out: there may be no surface. Raises
    ConfigError for shapes that differ, or too few pixels."""
    true, missing = np.asarray(true_m, np.float64).reshape(-1), np.asarray(no_return, bool).reshape(-1)
    if true.shape != missing.shape:
        raise ConfigError(f"true_m holds {true.size} pixels, no_return {missing.size}")
    known = np.isfinite(true) & (true > 0)
    if known.sum() < LEAST_PIXELS:
        raise ConfigError(f"{known.sum()} pixels have a true depth; no_return needs at least {LEAST_PIXELS}")
    true, missing = true[known], missing[known]
    parts = np.array_split(np.argsort(true), BINS)
    depths = np.array([true[part].mean() for part in parts])
    chance = np.array([missing[part].mean() for part in parts])
    share, depth, width = _likeliest(depths, chance, np.array([len(part) for part in parts]))
    return NoReturnFit(share, depth, width, depths, chance)


def _likeliest(
    depths: NDArray[np.float64], chance: NDArray[np.float64], pixels: NDArray[np.int64]
) -> tuple[float, float, float]:
    """Share, depth and width, on grids that close in on the best of the one before. The two lengths are
    spaced by factors."""
    low = np.array([0.0, np.log(0.3 * depths[0]), np.log(0.003 * depths[-1])])
    high = np.array([LARGEST_SHARE, np.log(5.0 * depths[-1]), np.log(2.0 * depths[-1])])
    lower, upper, best = low, high, low
    for _ in range(_ROUNDS):
        axes = [np.linspace(a, b, _STEPS) for a, b in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        share, half, width = grid[:, :1], np.exp(grid[:, 1:2]), np.exp(grid[:, 2:])
        q = np.clip(no_return_chance(depths, share, half, width), 1e-6, 1.0 - 1e-6)
        likelihood = (pixels * (chance * np.log(q) + (1.0 - chance) * np.log1p(-q))).sum(axis=1)
        best = grid[np.argmax(likelihood)]
        reach = 0.25 * (upper - lower)
        lower, upper = np.maximum(best - reach, low), np.minimum(best + reach, high)
    return float(best[0]), float(np.exp(best[1])), float(np.exp(best[2]))
