"""Source of a live run: a recording or a camera with a new map, or a saved map."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from taichi_mrf.calibration.from_recording import LearntSigma
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.doctor.diagnosis import doubtful_at_a_glance, mistakes
from taichi_mrf.datasets.entries import holds_frames
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.registry import format_name, recognise
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.summary import note_unused_color
from taichi_mrf.errors import ConfigError, DatasetError, MapFileError, TaichiMRFError
from taichi_mrf.mapping.intake import hold_out_of
from taichi_mrf.mapping.onto import Placed, freeze_all, placed_in
from taichi_mrf.mapping.tracking import wants_color
from taichi_mrf.methods.map_file import open_map_file, read_header
from taichi_mrf.methods.mrf.parked_chunks import folder_beside
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.session.noise import noise_notes
from taichi_mrf.session.replay import Replay
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_file, is_folder

LearnNoise = Callable[[Dataset, Config], LearntSigma]
"""Learns sigma from a recording that is to be mapped with some parameters."""

DEEP = 2
"""Recordings are looked for in a folder and in the folders in it: so many levels."""


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
    how sigma was learnt from it, if it was. ``own``: the map is another program's, which changes it.
    ``among``: what can be opened instead, with this source at ``place``."""

    name: str
    config: Config
    new_map: Callable[[], OccupancyMap]
    new_replay: Callable[[], Replay] | None = None
    tracked: bool = False
    dataset: Dataset | None = None
    choice: dict[str, Any] = field(default_factory=dict)
    learnt: LearntSigma | None = None
    own: bool = False
    among: "Recordings | None" = None
    place: int = 0

    @property
    def located(self) -> str:
        """How sure the place of the recording is in the map of an earlier one, in words; empty if the map is
        its own."""
        return self.dataset.located.in_words() if isinstance(self.dataset, Placed) else ""

    @property
    def hold_out(self) -> int:
        """One frame in so many is held out."""
        if self.dataset is None:
            return self.config.evaluation.hold_out
        return hold_out_of(self.dataset, self.config)


Opened = tuple[Source, list[str]]
"""A source that is open, and notes for the user."""


class Recordings:
    """The recordings and saved maps in a folder, which is none itself. ``names`` are their paths below it.
    Whoever chooses gives a place in this list, never a path."""

    def __init__(self, folder: str, names: tuple[str, ...], open_one: Callable[[str], Opened]) -> None:
        self.names, self._folder, self._open_one = names, Path(folder), open_one

    def open(self, place: int) -> Opened:
        """Open the one at a place. Raises ConfigError if there is none there, and what ``open_one`` does."""
        if not 0 <= place < len(self.names):
            raise ConfigError(f"{self._folder}: holds {len(self.names)} recordings, and none at {place}")
        source, notes = self._open_one(str(self._folder / self.names[place]))
        return dataclasses.replace(source, among=self, place=place), notes


def open_among(name: str, open_one: Callable[[str], Opened]) -> Opened:
    """Open a source; of a folder that is none but holds several, the first that can be opened, with the
    others to choose from. Raises what ``open_one`` does for the source itself."""
    recordings = Recordings(name, recordings_in(Path(name)), open_one)
    problems: list[str] = []
    for place, taken in enumerate(recordings.names if len(recordings.names) > 1 else ()):
        try:
            source, notes = recordings.open(place)
        except (DatasetError, MapFileError) as error:
            problems.append(str(error))
            continue
        several = f"{name} holds {len(recordings.names)} recordings: this is {taken}, the page has the others"
        return source, [*problems, several, *notes]
    return open_one(name)


def recordings_in(folder: Path) -> tuple[str, ...]:
    """The recordings and saved maps in a folder, by their paths below it; none if it is a recording itself.
    What a link outside the folder leads to is not in it."""
    if not is_folder(folder) or format_name(folder) != "unknown":
        return ()
    return tuple(path.relative_to(folder).as_posix() for path in _found_in(folder, folder.resolve(), DEEP))


def _found_in(folder: Path, top: Path, levels: int) -> Iterator[Path]:
    try:
        children = sorted(child for child in folder.iterdir() if not child.name.startswith((".", "__")))
    except OSError:  # a folder that may not be read
        return
    for child in children:
        if not child.resolve().is_relative_to(top):
            continue
        if recognise(child) is not None or _is_readable_map(child):
            yield child
        elif is_folder(child) and levels > 1:
            yield from _found_in(child, top, levels - 1)


def _is_map(path: Path) -> bool:
    return path.suffix == ".npz" and is_file(path) and not holds_frames(path)


def _is_readable_map(path: Path) -> bool:
    try:
        if _is_map(path):
            with open_map_file(path):
                return True
    except TaichiMRFError:  # arrays of something else
        pass
    return False


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
    onto: Path | None = None,
    frozen: bool = False,
    wait_for: Callable[[str], None] = lambda text: None,
) -> Opened:
    """Start Taichi and open a source, read as ``reading`` says; returns it with notes for the user. With
    ``track`` the poses of its frames are found by tracking, with ``poses`` they come from that file, and
    ``follow`` it as it changes. ``learn_noise`` learns sigma before a recording is mapped. With ``onto`` the
    frames are located in that saved map, whose parameters ``config`` has, and join it; its keyframes are kept
    ``frozen`` on demand. ``wait_for`` is told, in words, what a source that runs is waited for.

    Raises TaichiMRFError: DatasetError, MapFileError, BackendError, ConfigError.
    """
    runtime.init(config.runtime.arch, config.runtime.threads)
    path = Path(name)
    if _is_map(path):
        if poses is not None:
            raise ConfigError(
                f"{path}: is a saved map, whose keyframes have poses: --poses is for a recording"
            )
        if learn_noise is not None:
            raise ConfigError(
                f"{path}: is a saved map, which keeps its noise: --noise auto is for a recording"
            )
        if onto is not None:
            raise ConfigError(f"{path}: is a saved map: --onto is for a recording")
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
    if onto is None:
        config = with_recorded_noise(config, dataset)
    found = mistakes(dataset) if doubtful_at_a_glance(dataset) else []
    dataset.notes += [f"frames contradict each other: {'; '.join(found)}"] if found else []
    learnt = None if learn_noise is None else learn_noise(dataset, config)
    if learnt is not None:
        config = learnt.put_into(config)
    new_map: Callable[[], OccupancyMap] = partial(create_map, config, dataset.camera)
    if onto is not None:
        if dataset.endless:
            wait_for(f"waiting for views by which {name} is located in {onto}")
        m = load_map(onto, config.volume.memory_limit_gb)
        dataset = placed_in(m, str(onto), dataset, wait_for)
        new_map = partial(_earlier_map, [m], onto, config, frozen)
    # Held-out frames of a tracked source are read, so that their poses are known when the map is checked.
    unread = 0 if dataset.tracked else hold_out_of(dataset, config)

    def new_replay() -> Replay:
        return Replay(dataset, every=every, limit=limit, loop=loop, hold_out=unread, speed=speed)

    joined = {"onto": onto and str(onto), "frozen_before": frozen or None}
    chosen = {"every": every, "limit": limit, **joined}
    choice = {**chosen, "track_poses": track, "poses_from": poses, "follow": follow or None}
    if learnt is not None:
        choice["noise_from"] = "auto"
    notes = dataset.notes + noise_notes(config.sensor, None, learnt)
    return Source(name, config, new_map, new_replay, dataset.tracked, dataset, choice, learnt), notes


def _earlier_map(loaded: list[OccupancyMap], path: Path, config: Config, frozen: bool) -> OccupancyMap:
    """The saved map that a recording joins, at first the one that is ``loaded``; with ``frozen`` all its
    keyframes are."""
    m = loaded.pop() if loaded else load_map(path, config.volume.memory_limit_gb)
    if frozen:
        freeze_all(m)
    return m
