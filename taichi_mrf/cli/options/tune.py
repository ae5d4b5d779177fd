"""``taichi-mrf tune``: find parameters for a sensor and a scene, in the browser or by a search."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from taichi_mrf.cli.options.shared import NoiseFlags, Reading, Verbosity, check_least, check_port
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError

FRAMES_BY_HAND, FRAMES_TO_SEARCH = 12, 30


@dataclass(frozen=True)
class Tune:
    """Tune parameters on a few frames of a sequence, and see at once what they do.

    The page has sliders for the parameters; after each change a new map is built from some frames and scored
    on others. --auto searches instead. Ctrl-C ends the session and, with --out, saves the results (exit
    status 130). Example: taichi-mrf tune recording/ --auto 60 --out runs/tuned
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A folder, whose format is recognised, or a built-in sequence such as synthetic:room."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the results, created if needed: tries.csv, saved YAML files, best.yaml with --auto,
    sensor.yaml with --noise auto."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of initial parameters, such as those in configs/."""

    frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Number of frames, held-out ones included; 12 by default, 30 with --auto."""

    first: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Index of the first frame."""

    stride: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Take every N-th frame from the first; 0 spreads them evenly over the sequence, at most 10 apart."""

    hold_out: Annotated[int, tyro.conf.arg(metavar="N")] = 3
    """Hold out one frame in N to score the map. With --auto, half of them are also withheld from the search,
    for the final scores."""

    auto: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Search in N trials for parameters that score best on held-out frames (needs the extra auto: Optuna)."""

    objective: Literal["right", "depth-error", "fit"] = "fit"
    """Aim of the search: most pixels right within 1.5 voxels, smallest median depth error, or best fit, the
    log-likelihood of held-out measurements."""

    search: Annotated[str, tyro.conf.arg(metavar="NAME,...")] = ""
    """Parameters to search, separated by commas; sensor.sigma_scale multiplies all coefficients of
    sensor.sigma. By default prior, outlier floor, free share and sigma's scale."""

    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of the search's random numbers."""

    search_stride: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """The search maps and scores every N-th pixel in both directions; 0 chooses N so that 160 columns are
    left. Final scores use all pixels."""

    viewer: bool = True
    """Serve the page; --no-viewer needs --auto."""

    host: str = "127.0.0.1"
    """Address to serve the page at. With any other address, everyone who can reach it can use the page."""

    port: int = 8080
    """Port to serve the page at; the next free one is taken if it is busy."""

    open: bool = False
    """Open the page in a browser on this machine."""

    reading: Reading = field(default_factory=SourceFlags)
    """Options for reading SOURCE."""

    noise: Annotated[NoiseFlags, tyro.conf.arg(name="")] = field(default_factory=NoiseFlags)
    """Source of sigma."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters to begin with."""

    def __post_init__(self) -> None:
        check_least(self, frames=3, first=0, stride=0, hold_out=2, auto=1, seed=0, search_stride=0)
        check_port(self.port)
        if self.search and self.auto is None:
            raise ConfigError("--search needs a number of trials: add --auto N")
        if not self.viewer and self.auto is None:
            raise ConfigError("--no-viewer leaves nothing to do: add --auto N")

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters to search, none for the default ones."""
        return tuple(name.strip() for name in self.search.split(",") if name.strip())
