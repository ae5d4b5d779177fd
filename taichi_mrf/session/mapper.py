"""The map of a live run with its keyframes: adding, editing, and settling the map by full inference.

While frames come, each new keyframe is swept once, and then those whose cavity it has changed. That is
quick, but the map depends on the order of events. Settling runs full inference, after which the map depends
only on its keyframes and their poses, bit for bit.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import InferReport
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.methods.capabilities import can_freeze, has_messages, window_of
from taichi_mrf.methods.map_file import StoredKeyframe
from taichi_mrf.methods.protocol import OccupancyMap, PosedDepth
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence
from taichi_mrf.session.edits import Edit, EditHistory, Pair
from taichi_mrf.session.pictures import depth_colors, thumbnail
from taichi_mrf.session.shown_map import ShownMap
from taichi_mrf.system import runtime
from taichi_mrf.viewer import messages
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, KeyframeState

MOST_POINTS = 200_000
"""Most measured points of a keyframe that are shown."""


@dataclass
class LiveKeyframe:
    """One keyframe. ``map_id`` is its number in the map while it is on. While it is off, ``depth_m`` (H, W)
    is its depth image in metres, 0 for no measurement, ``color`` (H, W, 3) its colour image, if it has one,
    and ``own`` what it states of its measurements. A frozen keyframe has none of them. ``earlier``: it is of
    the map that the recording has joined.

    ``T_recorded`` is the recorded pose and ``T_home`` the one found by alignment, which is the same if poses
    are not refined; ``moved_by_hand``: a user has moved it elsewhere.
    """

    id: int
    name: str
    T_world_camera: Pose
    camera: Camera
    rays: int
    shown: Camera
    picture: NDArray[np.uint8]
    map_id: int | None
    stamp_s: float
    state: KeyframeState = "on"
    depth_m: NDArray[np.float32] | None = None
    color: NDArray[np.uint8] | None = None
    own: OwnEvidence = NOTHING
    moved_by_hand: bool = False
    earlier: bool = False

    def __post_init__(self) -> None:
        self.T_recorded = self.T_home = self.T_world_camera


FORGOTTEN = np.full((1, 1, 3), 90, np.uint8)
"""The picture of a keyframe whose depth image is no longer in memory."""

MOST_FROZEN = 2000
"""Frozen keyframes that a run remembers at most, for the camera's path and its times; even."""


@dataclass
class LiveKeyframes:
    """The keyframes of a run by number, in the order in which they came. A number is never given twice.

    ``entries`` holds all that can be changed. Of frozen ones, which ``frozen`` counts, it holds some along
    the path: a robot runs all day, and what each message costs must not grow.
    """

    entries: dict[int, LiveKeyframe] = field(default_factory=dict)
    next_id: int = 0
    frozen: int = 0

    def __post_init__(self) -> None:
        self._frozen: list[int] = []  # of those in entries, in the order in which they were frozen
        self._every = 1  # of so many frozen keyframes one is kept

    def add(
        self,
        frame: PosedDepth,
        rays: int,
        picture: tuple[Camera, NDArray[np.uint8]],
        map_id: int,
        stamp_s: float,
    ) -> LiveKeyframe:
        """Add a keyframe that has just been added to the map, with its pictures.thumbnail."""
        entry = LiveKeyframe(
            self.next_id, frame.name, frame.T_world_camera, frame.camera, rays, *picture, map_id, stamp_s
        )
        self.entries[entry.id] = entry
        self.next_id += 1
        return entry

    def freeze(self, entry: LiveKeyframe) -> None:
        """Note that a keyframe is frozen."""
        entry.map_id, entry.state, entry.picture = None, "frozen", FORGOTTEN
        if self._frozen and (self.frozen - 1) % self._every:  # the last one, kept as the newest so far
            del self.entries[self._frozen.pop()]
        self._frozen.append(entry.id)
        self.frozen += 1
        if len(self._frozen) > MOST_FROZEN:
            for id in self._frozen[1::2]:
                del self.entries[id]
            del self._frozen[1::2]
            self._every *= 2

    def find(self, id: int) -> LiveKeyframe:
        """A keyframe by the viewer's number. Raises KeyframeError."""
        if id not in self.entries:
            raise KeyframeError(f"there is no keyframe {id}")
        return self.entries[id]

    def with_state(self, state: KeyframeState) -> list[LiveKeyframe]:
        """Those that are on, off or frozen, the oldest first."""
        return [entry for entry in self.entries.values() if entry.state == state]


RENEW_SECONDS = 0.1
"""Seconds for which keyframes are swept again, at most, before frames and requests are handled."""


class Mapper:
    """A map and its keyframes as the page shows them.

    ``unsettled``: keyframes were added, removed or moved since the last full inference; ``edited``: some of
    them by a user; ``unaligned``: keyframes were added since all were aligned with each other, if poses are
    refined; ``cavities_changed``: the cavity of some keyframes may have changed since their last sweep.
    ``saved_unsettled``: the map comes from a file that was saved before its inference was complete.
    """

    def __init__(
        self,
        m: OccupancyMap,
        first_id: int = 0,
        refiner: PoseRefiner | None = None,
        own: bool = False,
        joined: bool = False,
    ) -> None:
        """A map that may have keyframes already; the viewer's numbers begin at ``first_id``. ``refiner``
        refines the map's poses, None if they stay. ``own``: another program makes the map; else one that has
        keyframes comes from a file. ``joined``: those are of an earlier recording, and frames follow."""
        self.map, self.refiner, self._joined = m, refiner, joined
        self.inferred: InferReport | None = None
        self.roster = LiveKeyframes(next_id=first_id)
        for id, keyframe in m.keyframes.items():
            picture = thumbnail(keyframe.camera, keyframe.depth_m)
            self.roster.add(keyframe, keyframe.rays, picture, id, keyframe.stamp_s).earlier = joined
        # A map from a file has beliefs but no messages; an edit needs full inference first.
        from_file = bool(m.keyframes) and not own
        self.lacks_messages = from_file and has_messages(m)
        self.saved_unsettled = from_file and not m.settled
        self.unsettled = self.saved_unsettled or self.stale
        self.shown = ShownMap(m, opened=self.lacks_messages and not (self.unsettled or joined))
        self.edited = False
        self.edits = EditHistory()
        self.unaligned = False
        self.cavities_changed = False

    @property
    def min_evidence(self) -> float:
        """Voxels whose published log-odds are nearer to the prior than this count as unknown."""
        return LOG_ODDS_STEP if self.map.METHOD.prior_is_unknown else self.map.config.volume.min_evidence

    def hello(self, source: str) -> messages.Hello:
        """The message that begins the map of a ``source`` in the viewer."""
        backend = runtime.choice()
        return messages.Hello(
            source=source,
            backend=backend.name if backend else "",
            device=backend.device if backend else "",
            method=self.map.config.method,
            voxel_size=self.map.voxel_size,
            prior_log_odds=self.map.view.pool.prior_log_odds,
            min_evidence=self.min_evidence,
            parameters="",
        )

    @property
    def stale(self) -> bool:
        """True if the map does not show the last edits until it is settled."""
        return self.map.stale

    def enter(self, added: Added) -> LiveKeyframe:
        """Note a keyframe that the intake has added to the map."""
        self.unsettled = self.cavities_changed = True
        self.unaligned = self.refiner is not None
        frame = added.frame
        entry = self.roster.add(
            frame, added.rays, thumbnail(frame.camera, frame.depth_m), added.keyframe, frame.stamp
        )
        entry.T_world_camera = entry.T_home = self.map.keyframes[added.keyframe].T_world_camera
        if self._joined:
            self.edits.join((messages.Switch(entry.id, False), messages.Switch(entry.id, True)))
        return entry

    def sweep(self, map_id: int) -> None:
        """Sweep a keyframe once, by its number in the map, unless the map is about to be rebuilt."""
        if not self.stale:
            self.map.infer(sweeps=1, keyframes=[map_id])

    def edit(self, edit: Edit) -> Pair:
        """Carry out an edit of one keyframe; returns what takes it back, and what makes it again. Raises
        KeyframeError."""
        id, before = edit.keyframe, self.roster.find(edit.keyframe)
        on, T = before.state == "on", before.T_world_camera
        if isinstance(edit, messages.Move):
            self.move(id, edit.T_world_camera)
            return messages.Move(id, T), edit
        wanted = not on if edit.on is None else edit.on
        self.switch(id, wanted)
        return messages.Switch(id, on), messages.Switch(id, wanted)

    def switch(self, id: int, on: bool) -> LiveKeyframe:
        """Take a keyframe out of the map, keeping its image, or bring it back. Raises KeyframeError."""
        entry = self._changeable(id)
        if on == (entry.state == "on"):
            return entry
        if on:
            entry.map_id = self._add(entry)
            if self.refiner is not None:
                self.refiner.note_recorded(entry.map_id, entry.T_recorded)
            entry.depth_m, entry.color, entry.own, entry.state = None, None, NOTHING, "on"
        else:
            keyframe = self._keyframe(entry)
            kept = keyframe.depth_m, keyframe.color, keyframe.own
            self.map.remove_keyframe(self._map_id(entry))
            entry.depth_m, entry.color, entry.own = kept
            entry.map_id, entry.state = None, "off"
        self.unsettled = self.edited = self.cavities_changed = True
        return entry

    def move(self, id: int, T_world_camera: Pose) -> LiveKeyframe:
        """Give a keyframe another pose. Raises KeyframeError."""
        entry, T = self._changeable(id), as_pose(T_world_camera)
        if entry.state == "on":
            self.map.move_keyframe(self._map_id(entry), T)
            self.sweep(self._map_id(entry))
            self.unsettled = self.edited = self.cavities_changed = True
        entry.T_world_camera, entry.moved_by_hand = T, True
        return entry

    def placed_by_hand(self) -> list[int]:
        """The keyframes, by their numbers in the map, that a user has moved: nothing else moves them."""
        return [self._map_id(entry) for entry in self.roster.with_state("on") if entry.moved_by_hand]

    def follow(self, moved: Collection[int]) -> list[LiveKeyframe]:
        """Note that the map has moved some keyframes, given by their numbers there, with the poses of a file,
        and swept them; returns them."""
        entries = [entry for entry in self.roster.with_state("on") if entry.map_id in moved]
        for entry in entries:
            entry.T_world_camera = entry.T_home = self._keyframe(entry).T_world_camera
            self.unsettled = self.cavities_changed = True
        return entries

    def align(self, entry: LiveKeyframe, T_world_camera: Pose) -> bool:
        """Move a keyframe that is on to its aligned pose, and sweep it once; returns whether it moved."""
        if np.array_equal(entry.T_world_camera, T_world_camera):
            return False
        self.map.move_keyframe(self._map_id(entry), T_world_camera)
        self.sweep(self._map_id(entry))
        self.unsettled = True
        entry.T_world_camera = entry.T_home = T_world_camera
        return True

    def freeze(self, id: int, by_hand: bool = True) -> messages.KeyframeInfo:
        """Freeze a keyframe: its evidence stays in the map permanently, its image is dropped. Returns
        the last message about it. Raises KeyframeError."""
        entry = self._changeable(id)
        if not can_freeze(self.map):
            raise KeyframeError(f"a map of the method {self.map.config.method} cannot freeze keyframes")
        if entry.state == "off":
            raise KeyframeError(f"keyframe {id} ({entry.name}) is off: switch it on to freeze it")
        crossed = self.crossed(entry)
        self.map.freeze_keyframe(self._map_id(entry))
        self.unsettled, self.edited = True, self.edited or by_hand
        return self._frozen(entry, crossed)

    def left_behind(self) -> list[messages.KeyframeInfo]:
        """The last messages about the keyframes that the map has frozen itself since this was last called,
        because they are outside of its window."""
        if window_of(self.map) is None:
            return []
        on = self.roster.with_state("on")
        nothing = np.zeros((0, 3), np.int32)
        return [self._frozen(entry, nothing) for entry in on if entry.map_id not in self.map.keyframes]

    def done_elsewhere(self) -> list[messages.KeyframeInfo] | None:
        """Note what another program has done to the map's keyframes since this was last called; returns
        messages about those that it has added, moved or frozen, None if it has removed some."""
        self.unsettled = self.cavities_changed = False  # that program infers, when it will
        on = {self._map_id(entry): entry for entry in self.roster.with_state("on")}
        gone = [id for id in on if id not in self.map.keyframes]
        if any(id not in getattr(self.map, "frozen", ()) for id in gone):
            return None
        found = [self._frozen(on[id], np.zeros((0, 3), np.int32)) for id in gone]
        for id, keyframe in self.map.keyframes.items():
            entry = on.get(id)
            if entry is None:
                picture = thumbnail(keyframe.camera, keyframe.depth_m)
                entry = self.roster.add(keyframe, keyframe.rays, picture, id, keyframe.stamp_s)
            elif np.array_equal(entry.T_world_camera, keyframe.T_world_camera):
                continue
            else:
                entry.T_world_camera = entry.T_home = keyframe.T_world_camera
            found.append(self.describe(entry))
        return found

    def renew(self) -> None:
        """Sweep the keyframes whose cavity has changed most, for at most RENEW_SECONDS."""
        if self.stale or not has_messages(self.map):
            self.cavities_changed = False
        else:
            self.cavities_changed = not self.map.renew(seconds=RENEW_SECONDS).complete

    def surplus(self, newest: LiveKeyframe, keep: int) -> list[LiveKeyframe]:
        """The keyframes to freeze if more than ``keep`` are on: those first that share least with the view
        of the newest."""
        on = self.roster.with_state("on")
        if not can_freeze(self.map):
            return on[: max(0, len(on) - keep)]
        entry_of = {self._map_id(entry): entry for entry in on}
        return [entry_of[id] for id in surplus(self.map, self._map_id(newest), keep)]

    @contextmanager
    def settling(self) -> Iterator[FullInference]:
        """Full inference, whose steps are taken in the ``with`` block. With its ``showing_before`` all
        queries and files show the map as it was before. If its outcome is None, the map is that again."""
        try:
            with FullInference(self.map, keep_before=True) as inference:
                yield inference
        except Exception:
            self.unsettled = self.lacks_messages = False  # or it would be tried again forever
            raise
        if inference.outcome is not None:
            self.inferred, self.lacks_messages = inference.outcome, False
            if inference.outcome.complete:
                self.unsettled = self.edited = self.cavities_changed = False

    def describe(self, entry: LiveKeyframe) -> messages.KeyframeInfo:
        """The message that describes a keyframe to the viewer."""
        return self._message(entry, entry.picture, self.crossed(entry))

    def crossed(self, entry: LiveKeyframe) -> NDArray[np.int32]:
        """The bricks that a keyframe's rays go through, (n, 3); none for one that is not on, and none in a
        map all of whose crossed bricks exist."""
        if entry.state != "on":
            return np.zeros((0, 3), np.int32)
        return self.map.crossed_bricks(self._map_id(entry))

    def depth_of(self, entry: LiveKeyframe) -> NDArray[np.float32] | None:
        """A keyframe's depth image, (H, W) in metres; None once it is frozen."""
        return self._keyframe(entry).depth_m if entry.state == "on" else entry.depth_m

    def points_of(self, id: int) -> messages.MeasuredPoints:
        """Measured points of a keyframe, :data:`MOST_POINTS` points at most. Raises KeyframeError."""
        entry = self.roster.find(id)
        depth_m = self.depth_of(entry)
        if depth_m is None:
            return messages.MeasuredPoints(id, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        seen = self._keyframe(entry).color if entry.state == "on" else entry.color
        colors = depth_colors(depth_m) if seen is None else seen
        there = np.isfinite(depth_m) & (depth_m > 0)
        every = -(-int(there.sum()) // MOST_POINTS) or 1
        points_m = points_at(entry.camera, depth_m)[there][::every].astype(np.float32)
        return messages.MeasuredPoints(id, points_m, colors[there][::every])

    def posed_image(self, entry: LiveKeyframe) -> StoredKeyframe:
        """A keyframe by the viewer's number, for the rays of its pixels. Raises KeyframeError for a frozen
        one."""
        depth_m = self.depth_of(entry)
        if depth_m is None:
            raise KeyframeError(
                f"keyframe {entry.id} ({entry.name}) is frozen: its depth image is no longer in memory"
            )
        own = self._keyframe(entry).own if entry.state == "on" else entry.own
        place = entry.T_world_camera, entry.camera, entry.stamp_s
        return StoredKeyframe(entry.id, entry.name, depth_m, *place, None, replace(own, images={}))

    def posed_images_near(self, point: NDArray[np.float64]) -> Iterator[StoredKeyframe]:
        """All keyframes that are on, the nearest to a point first."""
        entries = self.roster.with_state("on")
        entries.sort(key=lambda entry: float(np.linalg.norm(entry.T_world_camera[:3, 3] - point)))
        return map(self.posed_image, entries)

    def votes_at(self, points: Sequence[tuple[float, float, float]]) -> messages.Votes:
        """Votes of the keyframes that are on, on the voxels at some points, on average."""
        if not has_messages(self.map) or self.lacks_messages:
            return messages.Votes(points[0], (), known=False)
        said: defaultdict[int, float] = defaultdict(float)
        for point in points:
            for map_id, log_odds in self.map.votes_at(point).items():
                said[map_id] += log_odds / len(points)
        entries = self.roster.with_state("on")
        votes = [(e.id, said[e.map_id]) for e in entries if e.map_id is not None and e.map_id in said]
        return messages.Votes(points[0], tuple(sorted(votes, key=lambda vote: -abs(vote[1]))))

    def _frozen(self, entry: LiveKeyframe, crossed: NDArray[np.int32]) -> messages.KeyframeInfo:
        """Note that the map has frozen a keyframe; returns the last message about it."""
        picture = entry.picture
        self.roster.freeze(entry)
        self.edits.forget({entry.id})
        return self._message(entry, picture, crossed)

    def _add(self, entry: LiveKeyframe) -> int:
        """Add a keyframe that was off, and sweep it once. If that fails, the map is unchanged."""
        assert entry.depth_m is not None
        parts = (entry.T_world_camera, entry.camera, entry.name, entry.stamp_s, entry.color)
        map_id = self.map.add_keyframe(entry.depth_m, *parts, **entry.own.arguments())
        try:
            self.sweep(map_id)
        except BaseException:
            self.map.remove_keyframe(map_id)
            raise
        return map_id

    def _changeable(self, id: int) -> LiveKeyframe:
        entry = self.roster.find(id)
        if entry.state == "frozen":
            raise KeyframeError(f"keyframe {id} ({entry.name}) is frozen: it stays in the map as it is")
        return entry

    def _map_id(self, entry: LiveKeyframe) -> int:
        assert entry.map_id is not None, f"{entry.name} is {entry.state}"
        return entry.map_id

    def _keyframe(self, entry: LiveKeyframe) -> Keyframe | StoredKeyframe:
        return self.map.keyframes[self._map_id(entry)]

    def _message(
        self, entry: LiveKeyframe, picture: NDArray[np.uint8], crossed: NDArray[np.int32]
    ) -> messages.KeyframeInfo:
        return messages.KeyframeInfo(
            entry.id,
            entry.name,
            entry.T_world_camera,
            entry.shown,
            entry.rays,
            entry.state,
            picture,
            crossed,
            entry.T_home,
            entry.earlier,
            entry.stamp_s,
        )
