"""Datasets that show the frames of another one in another way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, StatedSensor
from taichi_mrf.errors import LostFrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame


@dataclass
class Derived(Dataset):
    """As many frames as ``source`` has, with the same names; subclasses define how a frame is read."""

    source: Dataset = field(kw_only=True)

    @property
    def endless(self) -> bool:
        """True if the source is."""
        return self.source.endless

    @property
    def stated(self) -> StatedSensor:
        """The source's."""
        return self.source.stated

    @property
    def origin_m(self) -> NDArray[np.float64]:
        """The source's."""
        return self.source.origin_m

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        """The source's."""
        return self.source.stamps()

    def pose(self, index: int) -> Pose:
        """The source's."""
        return self.source.pose(index)

    def sensor_of(self, index: int) -> str:
        """The source's."""
        return self.source.sensor_of(index)

    @property
    def frame_names(self) -> Sequence[str]:
        """The source's."""
        return self.source.frame_names


@dataclass
class Reposed(Derived):
    """The frames of ``source``, each (by index) at its pose of ``poses``, (4, 4) T_world_camera."""

    poses: Mapping[int, Pose] = field(kw_only=True)

    def pose(self, index: int) -> Pose:
        """The frame's pose. Raises LostFrameError if it has none."""
        if index not in self.poses:
            raise LostFrameError(f"{self.frame_names[index]}: pose unknown (tracking was lost)")
        return self.poses[index]

    def read(self, index: int) -> Frame:
        """The source's frame. Raises LostFrameError if it has no pose, and what the source raises."""
        T_world_camera = self.pose(index)
        return replace(self.source.read(index), T_world_camera=T_world_camera)


def reposed(dataset: Dataset, poses: Mapping[int, Pose]) -> Reposed:
    """The frames of a dataset at other poses."""
    return Reposed(dataset.name, dataset.camera, dataset.notes, dataset.dropped, source=dataset, poses=poses)


@dataclass
class Chosen(Derived):
    """Some frames of ``source``: those with the ``indices``."""

    indices: Sequence[int] = field(kw_only=True)

    @cached_property
    def frame_names(self) -> Sequence[str]:
        """Those of the chosen frames."""
        return [self.source.frame_names[index] for index in self.indices]

    def stamps(self) -> Sequence[float] | NDArray[np.float64]:
        """Those of the chosen frames."""
        stamps = self.source.stamps()
        return [float(stamps[index]) for index in self.indices]

    def pose(self, index: int) -> Pose:
        """The source's of that frame."""
        return self.source.pose(self.indices[index])

    def sensor_of(self, index: int) -> str:
        """The source's of that frame."""
        return self.source.sensor_of(self.indices[index])

    def read(self, index: int) -> Frame:
        """The source's frame. Raises what the source raises."""
        return self.source.read(self.indices[index])


def chosen(dataset: Dataset, indices: Sequence[int]) -> Chosen:
    """Some frames of a dataset, in the order of their ``indices``."""
    return Chosen(dataset.name, dataset.camera, source=dataset, indices=indices)
