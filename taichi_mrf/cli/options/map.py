"""``taichi-mrf map``: sequences in, for each a folder with the map, a report and pictures out."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.pose_flags import PoseFlags
from taichi_mrf.cli.options.verbosity import Verbosity
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError

_SOURCES = tyro.conf.arg(metavar="SOURCE...", help_behavior_hint="(required)")


@dataclass(frozen=True)
class Map:
    """Map recorded or built-in sequences.

    Flags take precedence over the file of --config, and that over the defaults. Ctrl-C keeps what is
    mapped (exit status 130), and so does memory that runs out (3). Examples:
    taichi-mrf map walk.bag --out runs/walk --voxel-size 0.02 and taichi-mrf map scans/* --out runs --jobs 4
    """

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, _SOURCES]
    """A folder, whose format is recognised, a bag (walk.bag?depth=/TOPIC&pose=/TOPIC), another file of
    frames, or a built-in sequence such as synthetic:room. 'taichi-mrf info SOURCE' says what is in it."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; it is made if need be. Several sources get a folder each in it, named after
    them, and a summary of all."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of parameters, such as those in configs/."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Look at every N-th frame only."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Look at no more than N frames."""

    skip_bad_frames: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave broken frames out and name them in the report, instead of stopping at the first."""

    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on with the map in DIR, with its parameters, after the last frame that is in it. Of several
    sources, those that are finished are left alone."""

    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace the run that DIR holds. Without it, a run of other parameters is refused."""

    keep_every: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 30.0
    """Save the keyframes so far at most so often, for --resume to go on with after a crash; at least so
    seldom that it takes no more than a twentieth of the time."""

    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Map so many of several sources at a time, each in a process of its own. They share the cores, and have
    one GPU each where there are several."""

    scheduler: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Map on the workers of this Dask scheduler, such as tcp://10.0.0.1:8786; 'local' starts Dask's own here,
    with a worker for each job."""

    submap_size: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Cut a sequence that is too large for one machine into columns of this many metres, infer each as a task
    of its own (see --jobs and --scheduler), and write the map in chunks, as map.zarr."""

    rounds: Annotated[int, tyro.conf.arg(metavar="N")] = 3
    """With --submap-size: let neighbouring submaps tell each other what they believe up to N times; no more
    often than it changes anything."""

    pictures: bool = True
    """Draw the map from above, in perspective, and against the measured depth."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the report as JSON, and nothing else, on stdout."""

    reading: Annotated[SourceFlags, tyro.conf.arg(name="")] = field(default_factory=SourceFlags)
    """How SOURCE is read."""

    poses: Annotated[PoseFlags, tyro.conf.arg(name="")] = field(default_factory=PoseFlags)
    """What becomes of SOURCE's poses."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """How much is printed."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters."""

    def __post_init__(self) -> None:
        for name in ("every", "limit", "jobs"):
            value = getattr(self, name)
            if isinstance(value, int) and value < 1:
                raise ConfigError(f"--{name} must be at least 1, not {value}")
        if self.sources is not tyro.MISSING and not self.sources:
            raise ConfigError("map needs a SOURCE")
        if self.resume and self.overwrite:
            raise ConfigError("--resume and --overwrite do not go together")
        if not self.keep_every >= 0:
            raise ConfigError(f"--keep-every must be a number of seconds, not {self.keep_every}")
