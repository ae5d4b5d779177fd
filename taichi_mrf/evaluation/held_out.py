"""Checking a map against frames of its own sequence that were kept out of it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.depth_error import DepthError, pooled_depth_error
from taichi_mrf.sensor.camera import Camera


@dataclass(frozen=True)
class HeldOutCheck:
    """The error over ``frames`` held-out frames together; ``skipped`` names the unreadable ones, each with
    its problem."""

    error: DepthError
    frames: int
    skipped: dict[str, str]


class RenderedMap(Protocol):
    """A map that predicts depth."""

    def render_depth(self, camera: Camera, T_world_camera: ArrayLike) -> NDArray[np.float32]: ...


def check_held_out(
    mapped: RenderedMap,
    dataset: Dataset,
    held_out: Sequence[int],
    on_frame: Callable[[int], None] = lambda number: None,
) -> HeldOutCheck:
    """Compare the depth that a map predicts at held-out views with the depth measured there.

    ``held_out`` are indices of the dataset. ``on_frame`` is called after each with its number from 1.
    """
    skipped: dict[str, str] = {}

    def depth_pairs() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        for number, index in enumerate(held_out, start=1):
            try:
                frame = dataset.read(index)
            except FrameError as error:
                skipped[dataset.frame_names[index]] = str(error)
            else:
                yield mapped.render_depth(frame.camera, frame.T_world_camera), frame.depth_m
            on_frame(number)

    error = pooled_depth_error(depth_pairs())
    return HeldOutCheck(error, len(held_out) - len(skipped), skipped)
