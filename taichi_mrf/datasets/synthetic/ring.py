"""``synthetic:ring``: once around a corridor that leads back to its beginning, with ground truth.

Options follow a question mark, ``synthetic:ring?frames=600&walls=bare``; the fields of :class:`RingOptions`
are the options. The way leads once around and a little further: the camera sees its first metres again.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from taichi_mrf.datasets.options import ReadOptions, parse_options
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderedSequence, RenderOptions
from taichi_mrf.datasets.synthetic.ring_plan import ring_scene, ring_way
from taichi_mrf.datasets.synthetic.smooth_way import SmoothWay
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

NAME = "synthetic:ring"
LAMP_OVER_EYE_M = 0.6


@dataclass(frozen=True)
class RingOptions(RenderOptions):
    """The options of the built-in ring corridor."""

    frames: int = 600
    """Views, evenly spread over the camera's way."""

    length: float = 60.0
    """Metres once around, along the middle of the corridor."""

    walls: Literal["furnished", "bare"] = "furnished"
    """Doors, pillars and furniture along the walls, or nothing but the walls."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(length=24)


@dataclass
class SyntheticRing(RenderedSequence):
    """The ring corridor as a sequence of frames."""

    options: RingOptions = RingOptions()

    @cached_property
    def scene(self) -> Scene:
        """The corridor in the world frame."""
        return ring_scene(self.options.length, bare=self.options.walls == "bare")

    @cached_property
    def way(self) -> SmoothWay:
        """Where the camera goes, in the world frame."""
        return ring_way(self.options.length)

    def lit(self, scene: Scene, T_world_camera: Pose) -> Scene:
        """A scene in the light of a lamp over the camera."""
        x, y, z = T_world_camera[:3, 3].tolist()
        return replace(scene, light=(x, y, z + LAMP_OVER_EYE_M))

    def pose_at(self, index: int) -> Pose:
        """T_world_camera of a frame, (4, 4)."""
        return self.way.pose_at(self.way.length_m * index / max(1, self.options.frames - 1))


def open_synthetic_ring(query: str, options: ReadOptions) -> SyntheticRing:
    """Open the ring corridor with the options after the question mark of its name.

    Raises DatasetError for an option that does not exist (naming the nearest), a value of the wrong
    type or out of range, and for a depth scale, which rendered depth does not have.
    """
    if options.depth_scale is not None:
        raise DatasetError(f"{NAME}: takes no depth_scale: its depth is in metres")
    ring = parse_options(RingOptions, query, NAME)
    return SyntheticRing(NAME, options.camera or ring.camera(), options=ring, color=options.color)
