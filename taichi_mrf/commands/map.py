"""``taichi-mrf map``: a sequence in, a folder with the map, a report and pictures out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf import config as configuration
from taichi_mrf.config import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError

CONFIG_FILE = "config.yaml"
"""Name of the effective configuration in the folder of a run."""


@dataclass(frozen=True)
class Map:
    """Map a recorded or built-in sequence.

    Flags take precedence over the file of --config, and that over the defaults. Ctrl-C keeps what is
    mapped (exit status 130), and so does memory that runs out (3).
    Example: taichi-mrf map walk.bag --out runs/walk --voxel-size 0.02
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A folder, whose format is recognised, a bag (walk.bag?depth=/TOPIC&pose=/TOPIC), another file of
    frames, or a built-in sequence such as synthetic:room. 'taichi-mrf info SOURCE' says what is in it."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; it is made if need be."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of parameters, such as those in configs/."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Look at every N-th frame only."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Look at no more than N frames."""

    skip_bad_frames: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave broken frames out and name them in the report, instead of stopping at the first."""

    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the map in DIR, with its parameters, after the last frame that is in it."""

    keep_every: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 30.0
    """Save the keyframes so far at most so often, for --resume to go on with after a crash; at least so
    seldom that it takes no more than a twentieth of the time."""

    refine_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Align each new keyframe with those before it, and all with each other at the end; the same as
    --poses.refine."""

    pictures: bool = True
    """Draw the map from above, in perspective, and against the measured depth."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the report as JSON, and nothing else, on stdout."""

    reading: Annotated[SourceFlags, tyro.conf.arg(name="")] = field(default_factory=SourceFlags)
    """How SOURCE is read."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters."""

    def __post_init__(self) -> None:
        for name in ("every", "limit"):
            value = getattr(self, name)
            if isinstance(value, int) and value < 1:
                raise ConfigError(f"--{name} must be at least 1, not {value}")
        if not self.keep_every >= 0:
            raise ConfigError(f"--keep-every must be a number of seconds, not {self.keep_every}")

    def parameters(self) -> Config:
        """The parameters with what flags of their own say."""
        if not self.refine_poses:
            return self.settings
        return replace(self.settings, poses=replace(self.settings.poses, refine=True))

    def run(self) -> int:
        """Map, write everything, and print the report. Raises TaichiMRFError."""
        from taichi_mrf.commands.map_run import run_map

        return run_map(self)


@dataclass(frozen=True)
class _Files:
    """The flags that say which file the other flags change."""

    config: Path | None = None
    out: Path | None = None
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False


def file_settings(arguments: Sequence[str]) -> Config:
    """The parameters before any flag: those of --config, or of the run that --resume goes on with.

    Raises ConfigError if that file cannot be read.
    """
    if {"-h", "--help"} & set(arguments):
        return Config()
    files, _ = tyro.cli(_Files, args=list(arguments), return_unknown_args=True, add_help=False)
    if files.config is not None:
        return configuration.load(files.config)
    if files.resume and files.out is not None and (files.out / CONFIG_FILE).is_file():
        return configuration.load(files.out / CONFIG_FILE)
    return Config()
