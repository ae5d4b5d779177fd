"""``taichi-mrf map``: sequences in, for each a folder with the map, a report and pictures out."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.shared import NoiseFlags, PoseFlags, Reading, Verbosity, check_least, check_onto
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError

_SOURCES = tyro.conf.arg(metavar="SOURCE...", help_behavior_hint="(required)")


@dataclass(frozen=True)
class Map:
    """Map recorded or built-in sequences.

    Flags override the file of --config, which overrides the defaults. Ctrl-C saves the map so far (exit
    status 130), and so does running out of memory (3). Examples:
    taichi-mrf map walk.bag --out runs/walk --voxel-size 0.02 and taichi-mrf map scans/* --out runs --jobs 4
    """

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, _SOURCES]
    """A recording: a folder (its format is recognised), a bag (walk.bag?depth=/TOPIC&pose=/TOPIC), another
    file of frames, or a built-in sequence such as synthetic:room. 'taichi-mrf info SOURCE' shows what is in
    it."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; created if needed. With several sources, each gets a subfolder named after it,
    and DIR gets a summary."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of parameters, such as those in configs/."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use only every N-th frame."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Use at most N frames."""

    skip_bad_frames: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Skip unreadable frames and list them in the report, instead of stopping at the first."""

    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Continue the run in DIR, with its parameters, after its last frame. With several sources, finished ones
    are skipped."""

    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace the run that DIR holds. Without this flag, a run with different parameters is refused."""

    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Map a recording even if it is certainly misread, and keep a map even if its held-out frames contradict
    it. Without this flag, both end with status 4, and so does an empty map."""

    onto: Annotated[Path | None, tyro.conf.arg(metavar="MAP")] = None
    """Continue the saved map of an earlier recording, with its parameters: SOURCE is located in it, and its
    keyframes are added to the map. A SOURCE that cannot be located with certainty is refused."""

    frozen: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """With --onto: keep the earlier keyframes as evidence only, without their images."""

    keep_every: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 30.0
    """Seconds between crash checkpoints; stretched automatically so that saving takes at most 5% of the
    run."""

    jobs: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Number of sources to map at a time, each in its own process. They share the cores; with several GPUs
    each gets one."""

    scheduler: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Map on the workers of this Dask scheduler, such as tcp://10.0.0.1:8786; 'local' starts a Dask cluster
    here, with one worker for each job."""

    submap_size: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Split a sequence that is too large for one machine into columns of this size, infer each as its own
    task (see --jobs and --scheduler), and write a chunked map, map.zarr."""

    rounds: Annotated[int, tyro.conf.arg(metavar="N")] = 3
    """With --submap-size: exchange beliefs between neighbouring submaps up to N times, and stop earlier once
    nothing changes."""

    noise: Annotated[NoiseFlags, tyro.conf.arg(name="")] = field(default_factory=NoiseFlags)
    """Source of sigma."""

    pictures: bool = True
    """Draw the measured surface, the map from above, and its depth against the measured depth."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the report as JSON, and nothing else, on stdout."""

    reading: Reading = field(default_factory=SourceFlags)
    """Options for reading SOURCE."""

    poses: Annotated[PoseFlags, tyro.conf.arg(name="")] = field(default_factory=PoseFlags)
    """Use of SOURCE's poses."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """Parameters."""

    def __post_init__(self) -> None:
        check_least(self, every=1, limit=1, jobs=1)
        if self.sources is not tyro.MISSING and not self.sources:
            raise ConfigError("map needs a SOURCE: a recording, or a built-in one such as synthetic:room")
        if self.resume and self.overwrite:
            raise ConfigError("--resume and --overwrite cannot be combined")
        if self.poses.file is not None and (len(self.sources) > 1 or self.submap_size is not None):
            raise ConfigError("--poses takes one SOURCE, and does not work with --submap-size")
        self.noise.refuse_with(
            track_poses=self.poses.track_poses, submap_size=self.submap_size, onto=self.onto
        )
        check_onto(self.onto, self.frozen, self.poses)
        if self.onto is not None and (len(self.sources) > 1 or self.submap_size is not None):
            raise ConfigError("--onto takes one SOURCE, and does not work with --submap-size")
        if not self.keep_every >= 0:
            raise ConfigError(f"--keep-every must be a number of seconds, not {self.keep_every}")
