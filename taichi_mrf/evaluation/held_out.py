"""Checking a map against frames of its own sequence that were kept out of it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.depth_error import DepthError, pooled_depth_error
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import PosedDepth
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel, without_bias

Render = Callable[[Camera, Pose], NDArray[np.float32]]
"""Predicts axial depth (H, W) at a pose, NaN where there is none."""


@dataclass(frozen=True)
class HeldOutCheck:
    """The error over ``frames`` held-out frames together; ``skipped`` names the unreadable ones, each with
    its problem."""

    error: DepthError
    frames: int
    skipped: dict[str, str]


def check_held_out(
    m: VoxelMap,
    dataset: Dataset,
    held_out: Sequence[int],
    on_frame: Callable[[int], None] = lambda number: None,
    render: Render | None = None,
) -> HeldOutCheck:
    """Compare the depth that a map predicts at held-out views with the depth measured there, of which the
    sensor's bias is taken.

    ``held_out`` are indices of the dataset. ``on_frame`` is called after each with its number from 1.
    ``render`` predicts depth in place of the map's own ``render_depth``.
    """
    predicted = render or m.render_depth
    skipped: dict[str, str] = {}

    def depth_pairs() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
        for number, index in enumerate(held_out, start=1):
            try:
                frame = dataset.read(index)
            except FrameError as error:
                skipped[dataset.frame_names[index]] = str(error)
            else:
                yield predicted(frame.camera, frame.T_world_camera), surface_depth(frame, m.noise)
            on_frame(number)

    error = pooled_depth_error(depth_pairs())
    return HeldOutCheck(error, len(held_out) - len(skipped), skipped)


def surface_depth(frame: PosedDepth, noise: NoiseModel) -> NDArray[np.float64]:
    """The depths that a frame measured, (H, W), without the bias of its own noise or of ``noise``, which is
    its map's; 0 where it measured nothing."""
    own = frame.own.noise
    return without_bias(frame.depth_m, (noise if own is None else own).table(frame.camera))
