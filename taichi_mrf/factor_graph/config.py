"""Every parameter of inference on explicit factor graphs, defined once.

A field's docstring is its help text, its default is the default, and its range is checked here. Energies are
negative log-likelihoods. Nothing in this file needs Taichi.
"""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.errors import ConfigError

Method = Literal["inverse", "mh", "mh-heat", "bp", "max-product", "dd", "dd-block"]
Sensor = Literal["piecewise", "gaussian"]
Schedule = Literal["parallel", "random", "residual"]

MOST_ENERGY = 4000.0
"""Largest energy of a beam: multipliers are kept as 32-bit integers in units of 1 / 4096."""

MOST_STEP = 10000.0
"""Largest first step of dual decomposition: a million of them, each smaller than the last, still fit."""


@dataclass(frozen=True)
class LaserConfig:
    """Parameters of mapping by inference on the factor graph of all beams."""

    cell_size: float = 0.18
    """Side of a cell in metres."""

    max_range: float = 0.0
    """A beam is cut off at this range (metres) and then hits nothing; 0 means no limit."""

    method: Method = "bp"
    """inverse is the inverse sensor model, mh Metropolis-Hastings, mh-heat the same with a heat map, bp
    sum-product belief propagation, max-product its maximising form, dd dual decomposition by subgradients,
    dd-block dual decomposition by block-coordinate ascent."""

    iterations: int = 100
    """Maximum number of iterations. Each updates every beam once; in Metropolis-Hastings it proposes as many
    flips as cells are crossed by beams. All methods stop earlier once nothing changes."""

    seconds: float = 0.0
    """Stop after this time; 0 means no limit."""

    seed: int = 0
    """Seed of all random choices. Results depend on it and not on the number of threads."""

    sensor: Sensor = "piecewise"
    """Forward sensor model: piecewise constant (eq. 26) or Gaussian (eqs. 25, 31)."""

    energy_explained: float = 1.0
    """Energy of a beam whose last cell alone is occupied, and of one without a return whose cells are all
    free."""

    energy_free: float = 900.0
    """Energy of a beam with a return whose cells are all free."""

    energy_wrong: float = 1000.0
    """Energy of every other case; the Gaussian model's energies never exceed it."""

    sigma: float = 0.1
    """Gaussian model: standard deviation of a range in metres."""

    log_odds: float = 1.3863
    """Inverse sensor model: log-odds that a return adds to its cell and subtracts from each cell before it
    (1.3863 is a probability of 0.8)."""

    start: Literal["random", "inverse"] = "random"
    """Metropolis-Hastings: the first labelling, at random (Alg. 1) or from the inverse sensor model."""

    chains: int = 2
    """Metropolis-Hastings: independent chains, which run in parallel."""

    heat_bias: float = 4.0
    """Metropolis-Hastings with a heat map: factor by which cells where beams end are proposed more often."""

    burn_in: float = 0.25
    """Metropolis-Hastings: share of the iterations that is left out of the marginals."""

    damping: float = 0.9
    """Belief propagation: share of an old message that is kept, 0 to below 1."""

    schedule: Schedule = "residual"
    """Belief propagation: all beams at once, in random order, or only those whose incoming messages have
    changed (over disagreeing nodes only)."""

    batches: int = 32
    """Number of batches of the random schedule. The beams of a batch are updated at once, and the next batch
    sees the result."""

    tolerance: float = 1.0
    """Belief propagation, residual schedule: minimum change of a cell's incoming log-odds that makes its
    beams send again. The method has converged when no cell has changed so much."""

    step: float = 50.0
    """Dual decomposition: the first step; step i is this divided by i + 1."""

    charge: Literal["whole", "mean"] = "whole"
    """Dual decomposition: update of the beams that disagree on a cell. whole is the whole step for each, as
    Alg. 2 is printed; mean is the projected subgradient, the beam's difference from the mean of all, which
    with a step of 1000 ends lower and has a far better bound."""

    polish: int = 5
    """Belief propagation and dual decomposition: maximum number of descent sweeps over the best labelling at
    the end; each flips every cell whose flip lowers the energy. 0 is the paper's method."""

    def __post_init__(self) -> None:
        positive = ("cell_size", "sigma", "log_odds", "heat_bias", "step")
        for name in positive:
            value = getattr(self, name)
            _check(math.isfinite(value) and value > 0, name, f"must be a positive number, not {value}")
        for name in ("max_range", "seconds", "tolerance"):
            _check(getattr(self, name) >= 0, name, "must not be negative")
        for name in ("energy_explained", "energy_free", "energy_wrong"):
            _check(abs(getattr(self, name)) <= MOST_ENERGY, name, f"must lie within +-{MOST_ENERGY:g}")
        for name in ("iterations", "polish"):
            _check(getattr(self, name) >= 0, name, "must not be negative")
        _check(self.step <= MOST_STEP, "step", f"must be at most {MOST_STEP:g}")
        _check(0 <= self.seed < 2**31, "seed", "must lie between 0 and 2^31 - 1")
        _check(1 <= self.chains <= 1024, "chains", "must lie between 1 and 1024")
        _check(1 <= self.batches <= 4096, "batches", "must lie between 1 and 4096")
        _check(0 <= self.burn_in < 1, "burn_in", "must be at least 0 and less than 1")
        _check(0 <= self.damping < 1, "damping", "must be at least 0 and less than 1")


def _check(ok: bool, name: str, problem: str) -> None:
    if not ok:
        raise ConfigError(f"laser.{name} {problem}")
