"""The options of the commands that measure: bench the speed here, eval the papers' tables."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.shared import Verbosity, check_least
from taichi_mrf.config.schema import Config, RuntimeConfig
from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class Bench:
    """Time a new keyframe of a live map at several voxel sizes, and OctoMap on the same frames.

    The first frames fill the map; medians are over the last ten frames (a quarter, if there are fewer than
    40). Example: taichi-mrf bench recording/ --voxel-sizes 0.05 0.02 --plot stages.png
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = "synthetic:room"
    """A folder, whose format is recognised, or a built-in sequence."""

    voxel_sizes: tuple[float, ...] = (0.05, 0.02, 0.01)
    """Voxel sizes in metres."""

    frames: int = 40
    """Number of frames to map, from the first on."""

    octomap: bool = True
    """Insert the same frames into OctoMap, if the extra 'bench' is installed."""

    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all figures to this file as well."""

    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Draw the figures to this file (.png, .svg or .pdf)."""

    gate: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Compare CPU times, relative to OctoMap's, with an earlier --json FILE of the same source; exit status 1
    if one is more than 10% larger."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters; the voxel size among them is not used."""

    def __post_init__(self) -> None:
        check_least(self, frames=1)
        if self.plot is not None and self.plot.suffix not in (".png", ".svg", ".pdf"):
            raise ConfigError(f"--plot {self.plot}: the file must end in .png, .svg or .pdf")
        if self.gate is not None and not self.octomap:
            raise ConfigError("--gate compares with OctoMap: leave out --no-octomap")


@dataclass(frozen=True)
class Eval:
    """Repeat an evaluation of the papers, and print its results beside theirs.

    Tables are written as CSV, LaTeX and PNG, with the configuration of every map. An
    interrupted run continues when it is started again with the same --out.
    Example: taichi-mrf eval table1 --data scenes/ --voxel-sizes 0.05 --limit 3
    """

    experiment: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERIMENT")]
    """table1, table2, table3 and fig7 to fig10 of MRFMap (Shankar and Michael 2020), stereo of Schauwecker
    and Zell 2014, exact, which compares MRFMap with the factor graph that it approximates (Dhiman et al.
    2014), peers, which compares all mappers that are installed, or all."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/eval")
    """Folder for the results; created if needed."""

    data: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("../shared/data")
    """Folder with the scenes, as data/README.md describes them; for table2 also one of Redwood's rooms, such
    as livingroom1/."""

    voxel_sizes: tuple[float, ...] = ()
    """Voxel sizes in metres, instead of the experiment's own."""

    seeds: tuple[int, ...] = (0, 1, 2, 3)
    """Seeds of the simulated noise: the first for all methods, the others for the spread of MRFMap."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Use at most N views or folds, for a quick look."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PART ...")] = ()
    """Run only these parts of the experiment peers, such as 'kitchen*'."""

    judge: Annotated[str | None, tyro.conf.arg(metavar="CONFIG")] = None
    """table3: map the house with a simulated RealSense D435, and evaluate the map with another sensor: its
    parameter file, or the name of a shipped one such as kinect_one."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)
    """Device that runs the kernels."""

    def __post_init__(self) -> None:
        check_least(self, limit=1)
        if not self.seeds:
            raise ConfigError("--seeds needs at least one number")
        if min(self.seeds) < 0:
            raise ConfigError(f"--seeds must not be negative, not {min(self.seeds)}")
        for name, values in (("seeds", self.seeds), ("voxel-sizes", self.voxel_sizes)):
            if len(set(values)) < len(values):
                raise ConfigError(f"--{name} holds a value twice: {values}")
        for size in self.voxel_sizes:
            if not 0 < size < float("inf"):
                raise ConfigError(f"--voxel-sizes must be positive numbers of metres, not {size}")
