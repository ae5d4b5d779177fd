"""``synthetic:corridor``: a long walk through a corridor and the furnished rooms off it, with ground truth.

Options follow a question mark, ``synthetic:corridor?rooms=4&frames=200&width=160&height=120``; the fields of
:class:`CorridorOptions` are the options.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.corridor_plan import corridor_scene, pose_on_way, waypoints
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

NAME = "synthetic:corridor"
LAMP_OVER_EYE_M = 0.6


@dataclass(frozen=True)
class CorridorOptions(RenderOptions):
    """The options of the built-in corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's way; 540 are left for the map when one in ten is kept out."""

    rooms: int = 12
    """Rooms off the corridor, which is 6.15 m long for every two."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(rooms=1)


@dataclass
class SyntheticCorridor(RenderedSequence):
    """The synthetic corridor as a sequence of frames, from its west end to its east end."""

    options: CorridorOptions = CorridorOptions()

    @cached_property
    def scene(self) -> Scene:
        """The corridor and its rooms, in the world frame."""
        return corridor_scene(self.options.rooms)

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        """A scene in the light of a lamp over the camera."""
        x, y, z = T_world_camera[:3, 3].tolist()
        return replace(scene, light=(x, y, z + LAMP_OVER_EYE_M))

    @cached_property
    def _way(self) -> NDArray[np.float64]:
        return waypoints(self.options.rooms)

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        return pose_on_way(self._way, index / max(1, self.options.frames - 1))


def open_synthetic_corridor(query: str, options: ReadOptions) -> SyntheticCorridor:
    """Open the corridor with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: takes no depth_scale: its depth is in metres")
    corridor = parse_options(CorridorOptions, query, NAME)
    return SyntheticCorridor(NAME, options.camera or corridor.camera(), options=corridor, color=options.color)
