"""``synthetic:room``: a furnished room that needs no download, with ground truth and a simulated sensor.

Options follow a question mark, ``synthetic:room?frames=60&width=640&height=480&noise=none&seed=1``; the
fields of :class:`RoomOptions` are the options.
"""

from dataclasses import dataclass
from functools import cached_property

from taichi_mrf.datasets.base import BuiltIn
from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.datasets.synthetic.room_furniture import camera_pose, room_scene
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

NAME = "synthetic:room"


@dataclass(frozen=True)
class RoomOptions(RenderOptions):
    """The options of the built-in room. At 32 frames the camera takes 6.4 s for its
    round."""


@dataclass
class SyntheticRoom(RenderedSequence):
    """The synthetic room as a sequence of frames; the camera's way through it is closed."""

    options: RenderOptions = RoomOptions()

    @cached_property
    def scene(self) -> Scene:
        """The solids in the room, in the world frame."""
        return room_scene()

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
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


BUILT_IN = BuiltIn(NAME, open_synthetic_room, rendered=True)
