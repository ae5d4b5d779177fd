"""Checks of a map against frames of its own sequence that were kept out of it, by the error of the depth that
it renders.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import FrameError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import PosedDepth
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel, without_bias

Render = Callable[[Camera, Pose], NDArray[np.float32]]
"""Predicts axial depth (H, W) at a pose, NaN where there is none."""


@dataclass(frozen=True)
class DepthError:
    """Rendered minus measured depth over some pixels, in metres; NaN where there is nothing to compare."""

    pixels: int
    """Number of pixels that have both depths."""

    unanswered: float
    """Share of the measured pixels, 0 to 1, for which the map has no surface."""

    median_abs: float
    """Median of the absolute difference in metres."""

    median: float
    """Median of the signed difference in metres; positive where the map lies behind the measurement."""

    rms: float
    """Root of the mean squared difference in metres."""


def depth_error(rendered_m: NDArray[np.floating], measured_m: NDArray[np.floating]) -> DepthError:
    """Compare a rendered depth image with a measured one, both (H, W) and in metres.

    A pixel is measured where its depth is finite and positive, and answered where the rendered depth
    is finite. Raises FrameError when the shapes differ.
    """
    return pooled_depth_error([(rendered_m, measured_m)])


def pooled_depth_error(
    pairs: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
) -> DepthError:
    """Depth error over the pixels of several (rendered, measured) images together.

    The residuals are pooled: a median of medians would weigh an almost empty image like a full one.
    """
    residuals: list[NDArray[np.float64]] = [np.zeros(0)]
    measured_pixels = 0
    for rendered_m, measured_m in pairs:
        residual = _residuals(rendered_m, measured_m)
        measured_pixels += residual.size
        residuals.append(residual[np.isfinite(residual)])
    pooled = np.concatenate(residuals)
    unanswered = 1.0 - pooled.size / measured_pixels if measured_pixels else float("nan")
    if pooled.size == 0:
        return DepthError(0, unanswered, float("nan"), float("nan"), float("nan"))
    return DepthError(
        pixels=pooled.size,
        unanswered=unanswered,
        median_abs=float(np.median(np.abs(pooled))),
        median=float(np.median(pooled)),
        rms=float(np.sqrt(np.mean(pooled**2))),
    )


def _residuals(rendered_m: NDArray[np.floating], measured_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rendered minus measured at the measured pixels, (N,); not finite where the map has no surface."""
    rendered, measured = np.asarray(rendered_m, np.float64), np.asarray(measured_m, np.float64)
    if rendered.shape != measured.shape:
        raise FrameError(f"depth images of shapes {rendered.shape} and {measured.shape} cannot be compared")
    has_depth = np.isfinite(measured) & (measured > 0)
    return rendered[has_depth] - measured[has_depth]


@dataclass(frozen=True)
class HeldOutCheck:
    """The error over ``frames`` held-out frames together; ``skipped`` names the unreadable ones, each with
    its problem. ``kept`` has some of the others by index, each with the depth (H, W) that the map predicts
    for it, in metres, NaN where there is none."""

    error: DepthError
    frames: int
    skipped: dict[str, str]
    kept: dict[int, tuple[Frame, NDArray[np.float32]]]


def check_held_out(
    m: VoxelMap,
    dataset: Dataset,
    held_out: Sequence[int],
    on_frame: Callable[[int], None] = lambda number: None,
    render: Render | None = None,
    keep: Collection[int] = (),
) -> HeldOutCheck:
    """Compare the depth that a map predicts at held-out views with the depth measured there, of which the
    sensor's bias is taken.

    ``held_out`` are indices of the dataset. ``on_frame`` is called after each with its number from 1.
    ``render`` predicts depth in place of the map's own ``render_depth``. The frames ``keep`` are kept.
    """
    predicted = render or m.render_depth
    skipped: dict[str, str] = {}
    kept: dict[int, tuple[Frame, NDArray[np.float32]]] = {}

    def depth_pairs() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
        for number, index in enumerate(held_out, start=1):
            try:
                frame = dataset.read(index)
            except FrameError as error:
                skipped[dataset.frame_names[index]] = str(error)
            else:
                rendered_m = predicted(frame.camera, frame.T_world_camera)
                if index in keep:
                    kept[index] = frame, rendered_m
                yield rendered_m, surface_depth(frame, m.noise)
            on_frame(number)

    error = pooled_depth_error(depth_pairs())
    return HeldOutCheck(error, len(held_out) - len(skipped), skipped, kept)


def surface_depth(frame: PosedDepth, noise: NoiseModel) -> NDArray[np.float64]:
    """The depths that a frame measured, (H, W), without the bias of its own noise or of ``noise``, which is
    its map's; 0 where it measured nothing."""
    own = frame.own.noise
    return without_bias(frame.depth_m, (noise if own is None else own).table(frame.camera))
