"""The frames of a recording without what the robot's own body covers (own_body.py).

A mask is of images as they are stored, so that it can be drawn over one of them, whatever undoes turns and
distortion later. Boxes are in the frame of the sensor, once these are undone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.derived import Derived, axial_depth
from taichi_mrf.datasets.images import decode_unchanged
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.errors import ConfigError, DatasetError, FrameError, naming
from taichi_mrf.sensor.camera import pinhole
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.own_evidence import free_up_to_m
from taichi_mrf.system.files import read_bytes

Body = tuple[NDArray[np.bool_], NDArray[np.float32]]
"""Pixels (H, W) that the body covers, and the depth up to which nothing else is there; 0 if unknown."""

Covered = Callable[[Frame], Body]

_MASK = "a mask is drawn over a depth image as it is stored, before --image-is, --undistort and --image-scale"


@dataclass
class WithoutBody(Derived):
    """The frames of ``source``, in which pixels that are ``covered`` are no measurements."""

    covered: Covered = field(kw_only=True)

    def read(self, index: int) -> Frame:
        """Raises what the source raises, and FrameError for images of another size than the mask's."""
        frame = self.source.read(index)
        covered, free_m = self.covered(frame)
        no_return = None if frame.no_return is None else frame.no_return * ~covered
        if free_m.any():
            others = np.zeros_like(free_m) if no_return is None else free_up_to_m(no_return)
            no_return = np.where(free_m > 0, free_m, others)
        depth_m = np.where(covered, np.float32(0), frame.depth_m)
        return replace(frame, depth_m=depth_m, no_return=no_return)


def masked(dataset: Dataset, file: str | None) -> Dataset:
    """A dataset, as it is stored, without the pixels that a mask has as 0. Raises DatasetError, which names
    the file, for one that cannot be read or does not fit."""
    if file is None:
        return dataset
    path = Path(file)
    with naming(str(dataset.name), ConfigError):
        shape = pinhole(dataset.camera, "--mask (--body-box works with lidars, too)").shape
    image = decode_unchanged(read_bytes(path, DatasetError, "the mask is missing"), str(path))
    if image.ndim != 2:
        raise DatasetError(
            f"{path}: the mask has {image.shape[2]} channels; it needs one, 0 for the body and 255 elsewhere"
        )
    if image.shape != shape:
        raise DatasetError(
            f"{path}: the mask has {image.shape[1]} x {image.shape[0]} pixels, the depth images of "
            f"{dataset.name} {shape[1]} x {shape[0]}; {_MASK}"
        )
    body = image == 0
    if body.all():
        raise DatasetError(f"{path}: the mask covers all pixels; 0 is the body, anything else the world")
    note = f"mask: {path} covers {body.mean():.1%} of the pixels"
    return _without(dataset, partial(_in_mask, body, path), note)


def without_body(dataset: Dataset, body: OwnBody, conventions: Conventions) -> Dataset:
    """A dataset without the measurements that end in a box of the sensor's frame, or that the body of a URDF
    covers. That of its ``conventions`` which is of depth is still to be undone. Raises DatasetError, which
    names the file, for a URDF or joints that cannot be read."""
    if body.robot is not None:
        from taichi_mrf.datasets.robot_model import RobotModel  # late: few have one

        model = RobotModel(body, conventions)
        dataset = _without(dataset, model.covered, model.note)
    if not body.body_box:
        return dataset
    boxes = body.body_box
    note = f"own body: measurements are left out in {len(boxes)} box{'es' * (len(boxes) > 1)}"
    return _without(dataset, partial(_in_boxes, np.reshape(boxes, (-1, 2, 3)), conventions), note)


def _without(dataset: Dataset, covered: Covered, note: str) -> WithoutBody:
    return WithoutBody(
        dataset.name,
        dataset.camera,
        [*dataset.notes, note],
        dataset.dropped,
        dataset.distortion,
        dataset.tracked,
        source=dataset,
        covered=covered,
    )


def _in_mask(body: NDArray[np.bool_], path: Path, frame: Frame) -> Body:
    if frame.depth_m.shape != body.shape:
        (rows, columns), (height, width) = frame.depth_m.shape, body.shape
        raise FrameError(
            f"frame {frame.name}: has {columns} x {rows} pixels, the mask {path} {width} x {height}; {_MASK}"
        )
    return body, np.zeros(body.shape, np.float32)


def _in_boxes(boxes: NDArray[np.float64], conventions: Conventions, frame: Frame) -> Body:
    depth_m = axial_depth(frame.depth_m, frame.camera, conventions)
    points = replace(frame, depth_m=depth_m).points_m[..., None, :]
    inside = ((points >= boxes[:, 0]) & (points <= boxes[:, 1])).all(axis=-1).any(axis=-1)
    covered: NDArray[np.bool_] = inside & (depth_m > 0)
    return covered, np.zeros(covered.shape, np.float32)
