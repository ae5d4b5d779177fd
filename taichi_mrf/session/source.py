"""Source of a live run: a recording or a camera with a new map, or a saved map."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from taichi_mrf.calibration.from_recording import LearntSigma
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.entries import holds_frames
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.summary import note_unused_color
from taichi_mrf.doctor.diagnosis import mistakes_at_a_glance
from taichi_mrf.errors import ConfigError
from taichi_mrf.mapping.intake import hold_out_of
from taichi_mrf.mapping.tracking import wants_color
from taichi_mrf.methods.map_file import open_map_file, read_header
from taichi_mrf.methods.mrf.parked_chunks import folder_beside
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.runs.noise import noise_notes
from taichi_mrf.session.replay import Replay
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_file

LearnNoise = Callable[[Dataset, Config], LearntSigma]
"""Learns sigma from a recording that is to be mapped with some parameters."""


def saved_unsettled(name: str) -> str:
    """The note on a saved map whose inference was interrupted."""
    return (
        f"{name} was saved before its inference was complete. It is shown as it was saved; "
        "inference over all keyframes now completes it."
    )


@dataclass(frozen=True)
class Source:
    """How to make the map (an empty one, or one from a file), and how to replay the frames, which a saved map
    does not have. ``tracked``: the poses of the frames are found by tracking. ``dataset`` is the recording,
    to check the map against its held-out frames; ``choice`` are the flags that chose its frames. ``learnt``:
    how sigma was learnt from it, if it was. ``own``: the map is another program's, which changes it."""

    name: str
    config: Config
    new_map: Callable[[], OccupancyMap]
    new_replay: Callable[[], Replay] | None = None
    tracked: bool = False
    dataset: Dataset | None = None
    choice: dict[str, Any] = field(default_factory=dict)
    learnt: LearntSigma | None = None
    own: bool = False

    @property
    def hold_out(self) -> int:
        """One frame in so many is held out."""
        if self.dataset is None:
            return self.config.evaluation.hold_out
        return hold_out_of(self.dataset, self.config)


def open_source(
    name: str,
    config: Config,
    *,
    every: int,
    limit: int | None,
    speed: float,
    loop: bool,
    reading: SourceFlags | None = None,
    track: bool = False,
    poses: str | None = None,
    follow: bool = False,
    learn_noise: LearnNoise | None = None,
) -> tuple[Source, list[str]]:
    """Start Taichi and open a source, read as ``reading`` says; returns it with notes for the user. With
    ``track`` the poses of its frames are found by tracking, with ``poses`` they come from that file, and
    ``follow`` it as it changes. ``learn_noise`` learns sigma before a recording is mapped.

    Raises TaichiMRFError: DatasetError, MapFileError, BackendError, ConfigError.
    """
    runtime.init(config.runtime.arch, config.runtime.threads)
    path = Path(name)
    if path.suffix == ".npz" and is_file(path) and not holds_frames(path):
        if poses is not None:
            raise ConfigError(
                f"{path}: is a saved map, whose keyframes have poses: --poses is for a recording"
            )
        if learn_noise is not None:
            raise ConfigError(
                f"{path}: is a saved map, which keeps its noise: --noise auto is for a recording"
            )
        with open_map_file(path) as file:
            header, parked = read_header(path, file), "parked" in file
        parameters = dataclasses.replace(header.config, runtime=config.runtime)
        notes = [f"{path.name} is a saved map: its own parameters are in force."]
        if not header.settled:
            notes.append(saved_unsettled(path.name))
        if parked:
            notes.append(
                f"It shows what is near the last keyframe; {folder_beside(path).name} has all of it."
            )
        return Source(path.name, parameters, lambda: load_map(path)), notes
    keywords = (reading or SourceFlags()).keywords()
    color = wants_color(config, name, track)
    dataset = open_posed(name, poses, follow=follow, track=track, color=color, **keywords)
    if not config.color and METHODS[config.method].has_colors:
        note_unused_color(dataset, name, reading or SourceFlags())
    config = with_recorded_noise(config, dataset)
    found = mistakes_at_a_glance(dataset)
    dataset.notes += [f"frames contradict each other: {'; '.join(found)}"] if found else []
    learnt = None if learn_noise is None else learn_noise(dataset, config)
    if learnt is not None:
        config = learnt.put_into(config)
    # Held-out frames of a tracked source are read, so that their poses are known when the map is checked.
    unread = 0 if dataset.tracked else hold_out_of(dataset, config)

    def new_replay() -> Replay:
        return Replay(dataset, every=every, limit=limit, loop=loop, hold_out=unread, speed=speed)

    new_map = partial(create_map, config, dataset.camera)
    chosen = {"every": every, "limit": limit}
    choice = {**chosen, "track_poses": track, "poses_from": poses, "follow": follow or None}
    if learnt is not None:
        choice["noise_from"] = "auto"
    notes = dataset.notes + noise_notes(config.sensor, None, learnt)
    return Source(name, config, new_map, new_replay, dataset.tracked, dataset, choice, learnt), notes
