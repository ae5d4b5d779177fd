"""One sequence to map into one folder: what `taichi-mrf map` does once or for several sources."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.shared import NoiseFlags, PoseFlags
from taichi_mrf.config.schema import Config, with_absolute_tables
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.source_flags import SourceFlags


@dataclass(frozen=True)
class MapTask:
    """One sequence to map into a folder; everything that decides what the files hold.

    Paths are relative to ``start``, the working directory of the command; those in ``settings`` are
    absolute.
    """

    source: str
    out: Path
    start: Path
    settings: Config
    reading: SourceFlags
    every: int = 1
    limit: int | None = None
    skip_bad_frames: bool = False
    resume: bool = False
    pictures: bool = True
    poses: PoseFlags = field(default_factory=PoseFlags)
    keep_every: float = Map.keep_every
    overwrite: bool = False
    noise: NoiseFlags = field(default_factory=NoiseFlags)

    def __str__(self) -> str:
        return self.source

    def choice(self) -> dict[str, Any]:
        """Choices besides the parameters; the report says them too."""
        noise = {} if self.noise == NoiseFlags() else {"noise_from": self.noise.origin}
        return {"every": self.every, "limit": self.limit, **noise, **self.poses.choice()}

    def open(self, color: bool) -> Dataset:
        """Open the sequence. Raises DatasetError."""
        flags = self.poses
        reading = {"color": color, **self.reading.keywords()}
        return open_posed(self.source, flags.file, follow=flags.follow, track=flags.track_poses, **reading)


def map_task(options: Map, source: str, out: Path) -> MapTask:
    """The part of a command that concerns one of its sources."""
    start = Path.cwd()
    return MapTask(
        source,
        out,
        start,
        with_absolute_tables(options.poses.parameters(options.settings), start),
        options.reading,
        options.every,
        options.limit,
        options.skip_bad_frames,
        options.resume,
        options.pictures,
        options.poses,
        options.keep_every,
        options.overwrite,
        options.noise,
    )
