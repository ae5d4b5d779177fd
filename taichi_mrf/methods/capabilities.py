"""Abilities of maps of some methods beyond OccupancyMap, and the questions that tell which map has them.

The rest of the program asks these questions instead of naming a class: the answer comes from the method's
entry, and a type checker then knows the verbs.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.alignment.refine import Aligner, RefinedPose
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.schedule import InferReport, Progress
from taichi_mrf.methods.mrf.inferring import Checkpoint
from taichi_mrf.methods.mrf.moving_window import MovingWindow
from taichi_mrf.methods.mrf.posed import PoseUpdate
from taichi_mrf.methods.mrf.reading import Layer, MapReading
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.change import MapChange
from taichi_mrf.queries.colored import ColoredMap


class MessageMap(OccupancyMap, Protocol):
    """A map whose keyframes keep the messages that they sent."""

    @property
    def keyframes(self) -> Mapping[int, Keyframe]: ...

    def renew(
        self,
        keyframes: Iterable[int] = (),
        tolerance: float | None = None,
        seconds: float | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Bring the marginals up to date without starting over."""
        ...

    def update_poses(
        self,
        poses: Mapping[int, ArrayLike],
        least: float = ...,
        tolerance: float | None = None,
        seconds: float | None = None,
    ) -> PoseUpdate:
        """Take in corrected poses, id -> (4, 4), within a time."""
        ...

    def checkpoint(self) -> Checkpoint:
        """State that :meth:`restore` needs to undo an :meth:`infer` that was stopped."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to a checkpoint; since then only :meth:`infer` may have been called."""
        ...


class FreezingMap(MessageMap, Protocol):
    """A map that can fold keyframes into itself for good."""

    window: MovingWindow | None
    """Window that is kept in memory, if not the whole map (``volume.window_m``)."""

    @property
    def frozen(self) -> Mapping[int, str]:
        """Names of the frozen keyframes, by id."""
        ...

    def freeze_keyframe(self, id: int) -> None:
        """Keep what a keyframe has contributed, and drop its image. Raises KeyframeError."""
        ...


class AligningMap(FreezingMap, Protocol):
    """A map that finds the poses of its keyframes."""

    aligner: Aligner

    def refine_pose(
        self, id: int, config: PoseConfig | None = None, guesses: Sequence[ArrayLike] = ()
    ) -> RefinedPose:
        """Move a keyframe to the pose near by under which its depth is most likely."""
        ...

    def depth_log_likelihood(self, id: int) -> float:
        """Mean log-likelihood of a keyframe's depth in the map of all others."""
        ...


class LayeredMap(OccupancyMap, Protocol):
    """A map that can be read as of another time and by layers, if its world may change."""

    @property
    def now_s(self) -> float:
        """The time that the map is for, in seconds; NaN without keyframes."""
        ...

    def layer(self, which: Layer = "both", stamp_s: float | None = None) -> MapReading:
        """One layer, or both, as believed at a time in seconds, now if None. Raises ConfigError in a map of
        a static world."""
        ...

    def decide(self, between: Callable[[], object] = ...) -> MapReading:
        """The map by what is occupied; ``between`` is called between its steps."""
        ...

    def changes(self, since_s: float) -> MapChange:
        """Changes since a time in seconds."""
        ...


class PaintedMap(OccupancyMap, ColoredMap, Protocol):
    """A map whose keyframes may have colour images."""

    def recent_colors(self) -> NDArray[np.uint8]:
        """Colours (slots * 512, 4) while keyframes come, at the price of the new ones."""
        ...


class MeasuringMap(OccupancyMap, Protocol):
    """A map that can make the surface that its keyframes measured."""

    @property
    def has_surface(self) -> bool:
        """True if no keyframe is missing in its surface."""
        ...

    def surface(self, between: Callable[[], object] = ...) -> FusedSurface:
        """The surface; ``between`` is called between its steps."""
        ...


def has_messages(m: OccupancyMap) -> TypeGuard[MessageMap]:
    """True if a map's keyframes keep messages."""
    return m.METHOD.has_messages


def can_freeze(m: OccupancyMap) -> TypeGuard[FreezingMap]:
    """True if a map can freeze keyframes."""
    return m.METHOD.can_freeze


def window_of(m: OccupancyMap) -> MovingWindow | None:
    """The window of a map that is not in memory as a whole, None for any other."""
    return m.window if can_freeze(m) else None


def can_refine_poses(m: OccupancyMap) -> TypeGuard[AligningMap]:
    """True if a map can align keyframes, and so be tracked in."""
    return m.METHOD.can_refine_poses


def has_layers(m: OccupancyMap) -> TypeGuard[LayeredMap]:
    """True if a map can be read as of another time and by layers. In a map of a static world they raise."""
    return m.METHOD.has_layers


def has_dates(m: OccupancyMap) -> TypeGuard[LayeredMap]:
    """True if a map's world may change, so that it can be read as of another time and by layers."""
    return m.view.pool.dated is not None


def takes_colors(m: OccupancyMap) -> TypeGuard[PaintedMap]:
    """True if keyframes of a map may have colour images."""
    return m.METHOD.has_colors


def measures_surface(m: OccupancyMap) -> TypeGuard[MeasuringMap]:
    """True if a map can make the surface that its keyframes measured."""
    return m.METHOD.measures_surface
