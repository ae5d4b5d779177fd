"""The keyframes of a live run, by numbers that stay the same when one is switched off and on again."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import PosedDepth
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence
from taichi_mrf.viewer.messages import KeyframeState


@dataclass
class LiveKeyframe:
    """One keyframe. ``map_id`` is its number in the map while it is on. While it is off, ``depth_m`` (H, W)
    is its depth image in metres, 0 for no measurement, ``color`` (H, W, 3) its colour image, if it has one,
    and ``own`` what it states of its measurements. A frozen keyframe has none of them.

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

    def __post_init__(self) -> None:
        self.T_recorded = self.T_home = self.T_world_camera


@dataclass
class LiveKeyframes:
    """All keyframes of a run by number, in the order in which they came. A number is never given twice."""

    entries: dict[int, LiveKeyframe] = field(default_factory=dict)
    next_id: int = 0

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

    def find(self, id: int) -> LiveKeyframe:
        """A keyframe by the viewer's number. Raises KeyframeError."""
        if id not in self.entries:
            raise KeyframeError(f"there is no keyframe {id}")
        return self.entries[id]

    def with_state(self, state: KeyframeState) -> list[LiveKeyframe]:
        """Those that are on, off or frozen, the oldest first."""
        return [entry for entry in self.entries.values() if entry.state == state]

    def clear(self) -> None:
        """Remove all keyframes; their numbers are not given again."""
        self.entries.clear()
