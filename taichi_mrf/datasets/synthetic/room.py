"""``synthetic:room``: a furnished room that needs no download, with ground truth and a simulated sensor.

Options follow a question mark, ``synthetic:room?frames=60&width=640&height=480&noise=none&seed=1``; the
fields of :class:`RoomOptions` are the options. ``synthetic:room?moving=walker&frames=60`` is a room in which
something happens, with a frame a second.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.moving_room import moving_room
from taichi_mrf.datasets.synthetic.moving_scene import MovingScene
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.datasets.synthetic.room_furniture import camera_pose, room_scene
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

NAME = "synthetic:room"


@dataclass(frozen=True)
class RoomOptions(RenderOptions):
    """The options of the built-in room. At 32 frames the camera takes 6.4 s for its
    round."""

    moving: Literal["none", "things", "door", "walker"] = "none"
    """What moves: nothing; things that appear, leave and are moved; a door; or a person who walks through. If
    something moves, the seed chooses places and times too, a frame is taken every second, and the camera
    looks at what happens."""


@dataclass
class SyntheticRoom(RenderedSequence):
    """The synthetic room as a sequence of frames; the camera's way through it is closed."""

    options: RoomOptions = RoomOptions()

    @cached_property
    def moving_scene(self) -> MovingScene | None:
        """Events in the room, in the world frame; None if nothing moves."""
        if self.options.moving == "none":
            return None
        return moving_room(self.options.moving, self.options.seed)

    @cached_property
    def scene(self) -> Scene:
        """The solids in the room that never move, in the world frame."""
        return self.moving_scene.static if self.moving_scene else room_scene()

    def scene_at(self, index: int) -> Scene:
        """All solids at the time of a frame."""
        return self.moving_scene.at(self.stamp_at(index)) if self.moving_scene else self.scene

    def stamp_at(self, index: int) -> float:
        """The time of a frame in seconds."""
        return float(index) if self.moving_scene else super().stamp_at(index)

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        if self.moving_scene:
            return self.moving_scene.camera.pose(self.stamp_at(index))
        return camera_pose(index / self.options.frames)


def open_synthetic_room(query: str, options: ReadOptions) -> SyntheticRoom:
    """Open the room with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: takes no depth_scale: its depth is in metres")
    room = parse_options(RoomOptions, query, NAME)
    return SyntheticRoom(NAME, options.camera or room.camera(), options=room, color=options.color)
