"""``taichi-mrf bench``: how long each stage takes here, and how long OctoMap takes for the same."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.shared import Verbosity, check_least
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError

MODES = ("viewer", "profile", "growth", "queries")


@dataclass(frozen=True)
class Bench:
    """Time what a new keyframe costs a live map, at several voxel sizes, beside OctoMap on the same frames.

    The first frames fill the map; medians are of the last ten (of a quarter, if there are fewer than 40).
    Example: taichi-mrf bench recording/ --voxel-sizes 0.05 0.02 --plot stages.png
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = "synthetic:room"
    """A folder, whose format is recognised, or a built-in sequence."""

    voxel_sizes: tuple[float, ...] = (0.05, 0.02, 0.01)
    """Voxel sizes in metres."""

    frames: int = 40
    """Number of frames to map, from the first on."""

    octomap: bool = True
    """Insert the same frames into OctoMap, where the extra 'bench' is installed."""

    profile: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show instead where the time goes: every kernel next to the bound that memory bandwidth sets, and the
    host's functions."""

    growth: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Measure instead how cost and memory grow with the number of earlier keyframes, in view and out of view:
    eight laps of the frames, at one place and at places 100 m apart."""

    viewer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Measure instead what each keyframe costs the live view: time on the server and bytes to a browser."""

    queries: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Measure instead how many points, balls and rays a second a planner can ask about, and what distances
    cost, of the whole map and after one more keyframe, beside OctoMap, SciPy and Open3D."""

    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write all figures to this file as well."""

    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Draw the figures to this file (.png, .svg or .pdf)."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """How much is printed."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters; the voxel size among them is not used."""

    def __post_init__(self) -> None:
        check_least(self, frames=1)
        chosen = [f"--{mode}" for mode in MODES if getattr(self, mode)]
        if len(chosen) > 1:
            raise ConfigError(f"{' and '.join(chosen)} do not go together")
        for mode in ("viewer", "queries"):
            if self.plot is not None and getattr(self, mode):
                raise ConfigError(f"--plot does not go with --{mode}")
        if self.plot is not None and self.plot.suffix not in (".png", ".svg", ".pdf"):
            raise ConfigError(f"--plot {self.plot}: the file must end in .png, .svg or .pdf")
