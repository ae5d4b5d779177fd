"""Today's recording in yesterday's map: located in it, and transformed into the map's world.

A few stretches of the recording are located in the surface that the map's keyframes have measured, by
alignment/locate_recording.py. Once one is found, all frames are read in the map's world, and are mapped as if
they had been taken in the same run.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.locate_recording import LocatedRecording, PlaceCheck, locate_any
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.scan import Scan, scan_of
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.alignment.whole_map import WholeMap, map_of_voxels, walls_of
from taichi_mrf.config.registry import methods_with
from taichi_mrf.config.schema import Config, KeyframeConfig
from taichi_mrf.config.text import differences
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.base import EndlessNames, StampedPoses
from taichi_mrf.datasets.derived import Derived, later
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.geometry.up import up_vector
from taichi_mrf.mapping.intake import Added, Intake, Lost, Passed
from taichi_mrf.mapping.selection import KeyframeSelector
from taichi_mrf.methods.capabilities import can_freeze, can_refine_poses
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.queries.points import FREE
from taichi_mrf.sensor.camera import sees_around
from taichi_mrf.sensor.frame import Frame

EVERYWHERE = np.full(3, np.inf)

MAY_DIFFER = (
    "inference.sweeps",
    "keyframes.",
    "evaluation.",
    "poses.close_loops",
    "runtime.",
    "volume.memory_limit_gb",
)
"""Parameters (or groups) in which a run that goes on with a map may differ from it."""


def parameters_onto(of_map: Config, asked: Config, default: Config, where: str) -> Config:
    """The parameters with which a recording goes on in a map: those ``of_map``, and those of MAY_DIFFER that
    are ``asked`` for and not the ``default``. Raises ConfigError, which begins with ``where``, for any other
    that is asked for and differs."""
    wanted = [name for name in differences(default, asked) if name != "fit_voxel_size"]
    others = set(differences(of_map, asked))
    refused = [name for name in wanted if name in others and not name.startswith(MAY_DIFFER)]
    if refused:
        raise ConfigError(
            f"{where}: was made with another {', '.join(refused)}, which applies to all that is added to it"
        )
    parameters = replace(of_map, runtime=asked.runtime, fit_voxel_size=False)
    for name in wanted:
        section, _, field_name = name.partition(".")
        if field_name:
            value = getattr(getattr(asked, section), field_name)
            changed = replace(getattr(parameters, section), **{field_name: value})
            parameters = replace(parameters, **{section: changed})
    return parameters


ReadFrame = Callable[[int], Frame]
Tell = Callable[[str], None]


def locate(
    m: OccupancyMap,
    frames: Sequence[Frame] | Dataset,
    T_map_recording: Pose | None = None,
    kept: dict[int, Frame] | None = None,
    tell: Tell = lambda text: None,
) -> LocatedRecording:
    """Find a recording in a map whose keyframes were taken in the same place at another time. If any of them
    are frozen, the recording is located by the map's voxels.

    ``frames`` have poses that fit each other, in any world, or are a dataset, whose camera may be tracked.
    With a guess ``T_map_recording`` (4, 4), the search stays near it. For an endless dataset, ``kept``
    receives the frames to be mapped, by index, because they cannot be read again, and ``tell`` receives the
    progress of the search. The answer has ``T_map_recording``, or None and a ``reason``. Raises ConfigError
    if keyframes cannot be aligned in a map of this method, or if the map has none, and what reading frames
    raises.
    """
    return _located(m, whole_map(m), frames, T_map_recording, {} if kept is None else kept, tell)


def _located(
    m: OccupancyMap,
    whole: WholeMap,
    frames: Sequence[Frame] | Dataset,
    T_map_recording: Pose | None,
    kept: dict[int, Frame],
    tell: Tell,
) -> LocatedRecording:
    parts = _stretches(m, frames, kept, tell)
    stretches: Iterable[Scan] = (scan_of(part, m.config.sensor, m.noise) for part in parts)
    if not (isinstance(frames, Dataset) and (frames.endless or frames.tracked)):
        stretches = list(stretches)  # the others take long
    nothing = "too little seen: no frame measures anything"
    return locate_any(stretches, whole, T_map_recording, nothing)


def whole_map(m: OccupancyMap) -> WholeMap:
    """The surface that a map's keyframes have measured, or, if any are frozen, that of its voxels. Raises
    ConfigError for an empty map, for one that does not know which way is up, and for a method that cannot
    align keyframes."""
    if not can_refine_poses(m):
        raise ConfigError(
            f"a recording can be located in maps of the method {methods_with('can_refine_poses')}, "
            f"not {m.METHOD.name}"
        )
    if m.up is None:
        raise ConfigError("nothing can be located in a map with neither keyframes nor a known up direction")
    if m.frozen:
        return map_of_voxels(m)
    m.aligner.surface.update(m.keyframes)
    surface = m.aligner.surface.around(-EVERYWHERE, EVERYWHERE)
    walls = walls_of(surface, [m.aligner.surface.of([id]) for id in m.keyframes])
    cameras_m = np.stack([keyframe.T_world_camera[:3, 3] for keyframe in m.keyframes.values()])
    return WholeMap(
        surface, walls, cameras_m, up_vector(m.up), lambda points: m.marginals.state(points) == FREE,
        m.colors if m.has_colors else None,
    )  # fmt: skip


def _stretches(
    m: OccupancyMap, frames: Sequence[Frame] | Dataset, kept: dict[int, Frame], tell: Tell
) -> Iterator[list[Frame]]:
    """Stretches of a recording, from its beginning and from further on."""
    if not isinstance(frames, Dataset):
        return _posed(frames.__getitem__, len(frames))
    if frames.tracked:
        return _tracked_live(m, frames, kept, tell) if frames.endless else _tracked(m, frames)
    return _posed(frames.read, len(frames), kept if frames.endless else None, tell)


STANDS_S = 10.0
"""An endless recording whose view has not changed for so long, in seconds of its stamps, is searched for by
what there is, if that is enough."""


def _posed(
    read: ReadFrame, count: int, kept: dict[int, Frame] | None = None, tell: Tell = lambda text: None
) -> Iterator[list[Frame]]:
    """Frames of a recording that has poses, in stretches that begin all along it. With ``kept`` it is
    endless: they are taken as they come, and put there. Broken frames are left out."""
    last, endless = -1, kept is not None
    ends = 0 if endless else count
    firsts = np.linspace(0, ends, RULES.whole_stretches, endpoint=False).astype(int)
    for first in firsts if endless else np.unique(firsts):
        part: list[Frame] = []
        for index in range(max(last + 1, int(first)), count):
            last = index
            try:
                frame = read(index)
            except FrameError:
                continue
            except DatasetError:
                if not part:
                    raise
                break  # nothing more comes, but there is something
            if _tells_more(part, frame):
                part.append(frame)
                if kept is not None:
                    kept[index] = frame
                    tell(_views(part))
            enough = endless and len(part) >= RULES.whole_fewest
            stands = enough and frame.stamp - part[-1].stamp > STANDS_S
            if len(part) == RULES.whole_frames or stands:
                break
        if part:
            yield part


def _tells_more(part: Sequence[Frame], frame: Frame) -> bool:
    """True if a frame measures anything, from elsewhere than the last of a stretch."""
    if not frame.depth_m.any():
        return False
    if not part:
        return True
    turned_rad, moved_m = tangent_norms(part[-1].T_world_camera, frame.T_world_camera)
    return moved_m > RULES.keyframe_m / 2 or turned_rad > RULES.keyframe_rad / 2


def _tracked(m: OccupancyMap, dataset: Dataset) -> Iterator[list[Frame]]:
    """Keyframes of a camera that is tracked in a map of its own, in stretches."""
    intake = Intake(create_map(m.config, dataset.camera), m.config, tracked=True)
    part: list[Frame] = []
    for index in range(len(dataset)):
        try:
            answer = intake.offer(dataset.read(index), index + 1, index)
        except FrameError:
            continue
        if isinstance(answer, Added):
            part.append(answer.frame)
        if len(part) == RULES.whole_frames:
            yield part
            part = []
    if part:
        yield part


MOST_KEPT = 100
"""Frames of a tracked camera that runs are kept until it is located, at most."""

KEPT_STEPS = KeyframeConfig(rotation=RULES.keyframe_rad / 4, translation=RULES.keyframe_m / 4)
"""Motion from one kept frame to the next, short enough to be tracked; one that stands still is not kept."""


def _tracked_live(
    m: OccupancyMap, dataset: Dataset, kept: dict[int, Frame], tell: Tell
) -> Iterator[list[Frame]]:
    """Keyframes of a camera that runs and is tracked, in stretches, each in a map and a world of its own:
    that of the first of its frames, which are ``kept`` as they came. None is searched for by fewer views: one
    view of a wall fits many places."""
    intake: Intake | None = None
    searched = 0
    for index in range(len(dataset)):
        if intake is None:
            kept.clear()
            part: list[Frame] = []
            selector = KeyframeSelector(KEPT_STEPS)
            intake = Intake(create_map(m.config, dataset.camera), m.config, tracked=True)
            tell(_views(part))
        try:
            frame = dataset.read(index)
            answer = intake.offer(frame, index + 1, index)
        except FrameError:
            continue
        if isinstance(answer, Added):
            part.append(answer.frame)
            tell(_views(part))
        found = answer.frame if isinstance(answer, Added | Passed) else None
        if part and found is not None and (found is part[-1] or selector.wants(found.T_world_camera)):
            selector.accept(found.T_world_camera)
            kept[index] = frame
        if len(kept) > MOST_KEPT:  # moved to and fro: any two of them are near each other
            for every_other in list(kept)[1::2]:
                del kept[every_other]
        if len(part) == RULES.whole_frames:
            tell("hold the camera still: its views are being located in the map")
            yield part
            searched += 1
            if searched == RULES.whole_stretches:
                return
            tell("not found there: show the camera another part of the place")
            intake = None
        elif isinstance(answer, Lost) and answer.in_a_row > RULES.long_lost:
            tell("the camera is lost, as it moved too fast or sees too little: it begins again")
            intake = None


def _views(part: Sequence[Frame]) -> str:
    return f"move the camera: {len(part)} of {RULES.whole_frames} views seen"


def placed_in(m: OccupancyMap, name: str, dataset: Dataset, tell: Tell = lambda text: None) -> "Placed":
    """The frames of a dataset in the world of a map, with names that the map does not have, and later than
    its newest keyframe if their clock begins before it. ``tell`` is told what an endless one is waited for.
    Raises DatasetError if the dataset is not found in the map, which is called ``name``."""
    kept: dict[int, Frame] = {}
    whole = whole_map(m)
    located = _located(m, whole, dataset, None, kept, tell)
    if located.T_map_recording is None:
        raise DatasetError(f"{dataset.name}: not found in {name}: {located.reason}")
    notes = [*dataset.notes, f"Located in {name}: {located.in_words()}."]
    newest_s = max((keyframe.stamp_s for keyframe in m.keyframes.values()), default=-np.inf)
    first_s = next(iter(kept.values())).stamp if kept else float(dataset.stamps()[0])
    later_s = newest_s + NEXT_S - first_s if first_s < newest_s else 0.0
    if later_s:
        notes.append(f"Its clock begins before the newest keyframe of {name}: {later_s:.0f} s are added.")
    return Placed(
        dataset.name,
        dataset.camera,
        notes,
        dataset.dropped,
        tracked=dataset.tracked,
        source=dataset,
        located=located,
        prefix=free_prefix(m, () if dataset.endless else dataset.frame_names),
        later_s=later_s,
        map_origin_m=np.asarray(m.config.volume.origin),
        kept=kept,
        walls=whole.walls,
        most_through=whole.may_look_through(sees_around(dataset.camera)),
    )


def place_check_of(dataset: Dataset | None) -> PlaceCheck | None:
    """The check of where a dataset was located in an earlier map; None if it was not."""
    if not isinstance(dataset, Placed) or dataset.walls is None:
        return None
    return PlaceCheck(dataset.walls, dataset.most_through)


def freeze_all(m: OccupancyMap) -> None:
    """Keep a map's keyframes as evidence only, if its method can."""
    if can_freeze(m):
        for id in list(m.keyframes):
            m.freeze_keyframe(id)


def free_prefix(m: OccupancyMap, names: Sequence[str] = ()) -> str:
    """Prefix under which none of the ``names`` is that of a keyframe of a map, empty if none is; without
    names, one under which no keyframe of the map stands yet."""
    taken = {keyframe.name for keyframe in m.keyframes.values()}
    taken |= set(m.frozen.values()) if can_freeze(m) else set()
    if names and taken.isdisjoint(names):
        return ""
    days = (f"{day}:" for day in itertools.count(2))
    return next(day for day in days if not any(name.startswith(day) for name in taken))


NEXT_S = 1.0
"""Seconds from a map's newest keyframe to the first frame of a recording whose clock began earlier."""


@dataclass
class Placed(Derived):
    """The frames of ``source`` in the world of a map, where they were ``located``.

    ``prefix`` goes before their names, and ``later_s`` is added to their stamps. ``kept`` are the first
    frames of an endless source, by the index under which they were read, which was located by them. They can
    be read again: a tracked camera begins where the first was taken. What is mapped may look through
    ``most_through`` of the map's ``walls``, at most.
    """

    located: LocatedRecording = field(kw_only=True)
    prefix: str = field(kw_only=True)
    later_s: float = field(kw_only=True)
    map_origin_m: NDArray[np.float64] = field(kw_only=True)
    kept: dict[int, Frame] = field(kw_only=True, default_factory=dict)
    walls: Planes | None = field(kw_only=True, default=None)
    most_through: float = field(kw_only=True, default=RULES.whole_through)

    def __post_init__(self) -> None:
        self._first = list(self.kept.values())
        self._left_out = max(self.kept, default=-1) + 1 - len(self.kept)
        self._next = 0

    def awaiting(self) -> str:
        """The source's answer, once the kept frames have been read."""
        return "" if self._next < len(self._first) else self.source.awaiting()

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """The map's."""
        return self.map_origin_m

    @property
    def frame_names(self) -> Sequence[str]:
        """The source's, after the prefix."""
        names = self.source.frame_names
        if isinstance(names, EndlessNames):
            return EndlessNames(f"{self.prefix}{names.prefix}")
        return [f"{self.prefix}{name}" for name in self.source.frame_names]

    @property
    def T_map_recording(self) -> Pose:
        """(4, 4): from the world of the recording to that of the map."""
        assert self.located.T_map_recording is not None
        return self.located.T_map_recording

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        """The source's, later."""
        return np.asarray(self.source.stamps(), np.float64) + self.later_s

    def pose(self, index: int) -> Pose:
        """The source's, in the map."""
        return self.T_map_recording @ self.source.pose(index)

    def own_poses(self) -> StampedPoses | None:
        """The source's, in the map."""
        known = self.source.own_poses()
        if known is None:
            return None
        stamps, poses = known
        return np.asarray(stamps, np.float64) + self.later_s, [self.T_map_recording @ T for T in poses]

    def read(self, index: int) -> Frame:
        """The source's frame, in the map. Raises what the source raises."""
        self._next, kept = index + 1, index < len(self._first)
        frame = self._first[index] if kept else self.source.read(index + self._left_out)
        return replace(
            later(frame, self.later_s),
            T_world_camera=self.T_map_recording @ frame.T_world_camera,
            name=f"{self.prefix}{frame.name}",
            origin_m=tuple(self.map_origin_m),
        )
