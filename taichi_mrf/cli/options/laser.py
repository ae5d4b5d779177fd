"""``taichi-mrf laser``: scans of a 2D laser scanner in, a floor map out."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from taichi_mrf.cli.options.shared import Verbosity, check_least
from taichi_mrf.config.schema import RuntimeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.factor_graph.config import LaserConfig, Method


@dataclass(frozen=True)
class Laser:
    """Map 2D laser scans with known poses by inference on a factor graph whose factors are whole beams.

    Flags override the file of --config, which overrides the defaults. Ctrl-C ends the current
    method and saves its map so far (exit status 130). Example: taichi-mrf laser walk.log.gz --out
    runs/floor --cell-size 0.05
    """

    scans: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCANS")]
    """A CARMEN log (plain or gzip), an npz file of scans or the folder that holds it, or the built-in
    synthetic:floor-plan."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; created if needed."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of parameters, such as the config.yaml of an earlier run."""

    compare: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run every method, and draw their energies against time and their maps side by side."""

    steps: Annotated[str | None, tyro.conf.arg(metavar="A,B,..")] = None
    """Run dual decomposition with each of these first steps, and draw their energies against time."""

    truth: Annotated[Path | None, tyro.conf.arg(metavar="IMAGE")] = None
    """Floor plan to score the map against, dark at walls, centred on the scans' origin."""

    truth_size: Annotated[str | None, tyro.conf.arg(metavar="W,H")] = None
    """Width and height of the floor plan's image in metres."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use only every N-th scan."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Use at most N scans."""

    skip_bad_scans: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Skip unreadable scans and count them in the report, instead of stopping at the first."""

    no_returns: Literal["auto", "free", "ignore"] = "auto"
    """Meaning of a beam without a return: its path is free, or nothing (ignore). auto ignores those of CARMEN
    logs, most of which met glass or dark surfaces, and uses the others."""

    no_return_range: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Beams of at least this range have no return. By default it is detected in a CARMEN log, and an npz file
    states it."""

    memory_limit_gb: float = 0.0
    """Memory limit of the factor graph in GB; 0 uses what the machine has free."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the report as JSON, and nothing else, on stdout."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[LaserConfig, tyro.conf.arg(name="")] = field(default_factory=LaserConfig)
    """Parameters."""

    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    """Device that runs the kernels."""

    def __post_init__(self) -> None:
        check_least(self, every=1, limit=1)
        if self.no_return_range is not None and not 0 < self.no_return_range < math.inf:
            raise ConfigError(f"--no-return-range must be a positive number, not {self.no_return_range}")
        if not 0 <= self.memory_limit_gb < math.inf:
            raise ConfigError(f"--memory-limit-gb must be 0 or a positive number, not {self.memory_limit_gb}")
        if (self.truth is None) != (self.truth_size is None):
            raise ConfigError("--truth and --truth-size go together: the image, and its size in metres")
        if self.truth_size is not None:
            self.truth_size_x_y()
        if self.compare and self.steps is not None:
            raise ConfigError("--compare and --steps are two different comparisons: give one of them")
        self.runs()

    def truth_size_x_y(self) -> tuple[float, float]:
        """The floor plan's width and height in metres. Raises ConfigError if the text is not two numbers."""
        try:
            width, height = map(float, (self.truth_size or "").split(","))
        except ValueError:
            width = height = math.nan
        if not (0 < width < math.inf and 0 < height < math.inf):
            raise ConfigError(f"--truth-size must be W,H in metres, such as 16,16, not {self.truth_size!r}")
        return width, height

    def runs(self) -> dict[str, LaserConfig]:
        """Settings to run, by name: one method, all of them, or the steps. Raises ConfigError."""
        if self.compare:
            return {name: replace(self.settings, method=name) for name in get_args(Method)}
        if self.steps is None:
            return {self.settings.method: self.settings}
        runs = {}
        for text in self.steps.split(","):
            try:
                step = float(text)
            except ValueError:
                raise ConfigError(
                    f"--steps must be numbers with commas between them, such as 20,50,100, not {self.steps!r}"
                ) from None
            runs[f"dd-step-{step:g}"] = replace(self.settings, method="dd", step=step)
        return runs
