"""The map of a live run with its keyframes: adding, editing, and settling the map by full inference.

While frames come, each new keyframe is swept once, and then those whose cavity it has changed. That is
quick, but the map depends on the order of events. Settling runs full inference, after which the map depends
only on its keyframes and their poses, bit for bit.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.inference.schedule import InferReport
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.selection import surplus
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.methods.capabilities import can_freeze, has_messages, window_of
from taichi_mrf.methods.protocol import MappedKeyframe, OccupancyMap
from taichi_mrf.sensor.own_evidence import NOTHING
from taichi_mrf.session.live_keyframes import LiveKeyframe, LiveKeyframes
from taichi_mrf.session.pictures import thumbnail
from taichi_mrf.session.ray_answers import PosedDepthImage
from taichi_mrf.session.shown_map import ShownMap
from taichi_mrf.viewer import messages
from taichi_mrf.viewer.messages import LOG_ODDS_STEP

RENEW_SECONDS = 0.1
"""Seconds for which keyframes are swept again, at most, before frames and requests are handled."""

FORGOTTEN = np.full((1, 1, 3), 90, np.uint8)
"""The picture of a keyframe whose depth image is no longer in memory."""


class Mapper:
    """A map and its keyframes as the page shows them.

    ``unsettled``: keyframes were added, removed or moved since the last full inference; ``edited``: some of
    them by a user; ``unaligned``: keyframes were added since all were aligned with each other, if poses are
    refined; ``cavities_changed``: the cavity of some keyframes may have changed since their last sweep.
    ``saved_unsettled``: the map comes from a file that was saved before its inference was complete.
    """

    def __init__(self, m: OccupancyMap, first_id: int = 0, refiner: PoseRefiner | None = None) -> None:
        """A map that may have keyframes already; the viewer's numbers begin at ``first_id``. ``refiner``
        refines the map's poses, None if they stay."""
        self.map, self.refiner = m, refiner
        self.inferred: InferReport | None = None
        self.roster = LiveKeyframes(next_id=first_id)
        for id, keyframe in m.keyframes.items():
            self.roster.add(
                keyframe, keyframe.rays, thumbnail(keyframe.camera, keyframe.depth_m), id, keyframe.stamp_s
            )
        # A map from a file has beliefs but no messages; an edit needs full inference first.
        self.lacks_messages = bool(m.keyframes) and has_messages(m)
        self.saved_unsettled = bool(m.keyframes) and not m.settled
        self.unsettled = self.saved_unsettled or self.stale
        self.shown = ShownMap(m, opened=self.lacks_messages and not self.unsettled)
        self.edited = False
        self.unaligned = False
        self.cavities_changed = False

    @property
    def min_evidence(self) -> float:
        """Voxels whose published log-odds are nearer to the prior than this count as unknown."""
        return LOG_ODDS_STEP if self.map.METHOD.prior_is_unknown else self.map.config.volume.min_evidence

    @property
    def stale(self) -> bool:
        """Whether the map does not show the last edits until it is settled."""
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
        return entry

    def sweep(self, map_id: int) -> None:
        """Sweep a keyframe once, by its number in the map, unless the map is about to be rebuilt."""
        if not self.stale:
            self.map.infer(sweeps=1, keyframes=[map_id])

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

    def posed_image(self, entry: LiveKeyframe) -> PosedDepthImage:
        """A keyframe's depth image with its pose, for the rays of its pixels. Raises KeyframeError for a
        frozen one."""
        depth_m = self.depth_of(entry)
        if depth_m is None:
            raise KeyframeError(
                f"keyframe {entry.id} ({entry.name}) is frozen: its depth image is no longer in memory"
            )
        own = self._keyframe(entry).own if entry.state == "on" else entry.own
        return PosedDepthImage(entry.name, entry.T_world_camera, entry.camera, depth_m, entry.id, own)

    def posed_images_near(self, point: NDArray[np.float64]) -> Iterator[PosedDepthImage]:
        """All keyframes that are on, the nearest to a point first."""
        entries = self.roster.with_state("on")
        entries.sort(key=lambda entry: float(np.linalg.norm(entry.T_world_camera[:3, 3] - point)))
        return map(self.posed_image, entries)

    def _frozen(self, entry: LiveKeyframe, crossed: NDArray[np.int32]) -> messages.KeyframeInfo:
        """Note that the map has frozen a keyframe; returns the last message about it."""
        picture, entry.picture = entry.picture, FORGOTTEN
        entry.map_id, entry.state = None, "frozen"
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

    def _keyframe(self, entry: LiveKeyframe) -> MappedKeyframe:
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
        )
