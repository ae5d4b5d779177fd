"""Frames whose pixels are picked from those of another dataset: undistorted, thinned out, or both.

Each output pixel is one recorded measurement: the one nearest to where its ray crosses the recorded image.
Nothing is averaged. An average would mix the depths on both sides of an edge into surfaces that do not exist,
and the mean or the minimum of several pixels has another noise than the sensor model assumes (the minimum of
four is one sigma too near).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.derived import Derived
from taichi_mrf.errors import ConfigError, FrameError, naming
from taichi_mrf.sensor.camera import Camera, PinholeCamera, pinhole
from taichi_mrf.sensor.frame import Frame


@dataclass
class Resampled(Derived):
    """The frames of ``source``, each pixel of them picked from the recorded image.

    ``rows`` and ``columns`` (H, W) int64 say which pixel each of this camera's pixels takes, -1 where its ray
    did not meet the recorded image, which is no measurement. One in ``stride`` of them is kept; if they are
    not ``distorted``, frames may have cameras of their own.
    """

    rows: NDArray[np.int64] = field(kw_only=True)
    columns: NDArray[np.int64] = field(kw_only=True)
    stride: int = field(kw_only=True)
    distorted: bool = field(kw_only=True)

    def read(self, index: int) -> Frame:
        """Read the source's frame and pick its pixels. Raises what the source raises."""
        frame = self.source.read(index)
        if frame.depth_m.shape != self.source.camera.shape:
            raise FrameError(f"{frame.name}: the image has the shape {frame.depth_m.shape}")
        outside = self.rows < 0
        depth_m = frame.depth_m[self.rows, self.columns]
        depth_m[outside] = 0.0
        color = None
        if frame.color is not None:
            color = frame.color[self.rows, self.columns]
            color[outside] = 0
        sigma_m = None if frame.sigma_m is None else frame.sigma_m[self.rows, self.columns]
        no_return = None if frame.no_return is None else frame.no_return[self.rows, self.columns] & ~outside
        return replace(
            frame,
            depth_m=depth_m,
            camera=self._camera(frame),
            color=color,
            sigma_m=sigma_m,
            no_return=no_return,
        )

    def _camera(self, frame: Frame) -> Camera:
        """The camera of the pixels that are kept of a frame."""
        if frame.camera == self.source.camera:
            return self.camera
        if self.distorted:
            raise FrameError(f"frame {frame.name}: has intrinsics of its own; --undistort needs --camera too")
        return strided(pinhole(frame.camera, "--image-scale"), self.stride)[0]


def resampled(dataset: Dataset, distortion: Sequence[float], stride: int) -> Dataset:
    """The dataset with its images undistorted and one in ``stride`` of their rows and columns kept.

    ``distortion`` are OpenCV's coefficients of the recorded images (none or zeros: they are a pinhole
    camera's). The camera keeps its intrinsics but for the stride. Raises DatasetError if nothing would be
    left of an image, and if its camera is no pinhole.
    """
    distorted = any(distortion)
    if not distorted and stride == 1:
        return dataset
    with naming(dataset.name, ConfigError):
        recorded = pinhole(dataset.camera, "--undistort" if distorted else "--image-scale")
    with naming(f"{dataset.name}: image_scale 1/{stride} leaves no pixel", ConfigError):
        camera, first = strided(recorded, stride)
    rows, columns = np.meshgrid(
        first[0] + stride * np.arange(camera.height),
        first[1] + stride * np.arange(camera.width),
        indexing="ij",
    )
    notes = list(dataset.notes)
    if distorted:
        rows, columns = _recorded_pixels(recorded, distortion, rows, columns)
        share = float((rows < 0).mean())
        notes.append(
            f"images undistorted with {', '.join(f'{k:g}' for k in distortion)}, "
            f"{share:.1%} of their pixels lie outside the recorded ones"
        )
    if stride > 1:
        notes.append(f"one in {stride} rows and columns is read: {camera.width} x {camera.height} pixels")
    return Resampled(
        name=dataset.name,
        camera=camera,
        notes=notes,
        dropped=dataset.dropped,
        source=dataset,
        rows=rows,
        columns=columns,
        stride=stride,
        distorted=distorted,
    )


def strided(camera: PinholeCamera, stride: int) -> tuple[PinholeCamera, tuple[int, int]]:
    """The camera of every ``stride``-th row and column, and the (row, column) of the first that is kept.

    Its rays are exactly those of the kept pixels: a principal point that were scaled about the image's corner
    would be off by up to half a recorded pixel. Raises ConfigError if no row or no column is left.
    """
    first = (stride - 1) // 2
    thin = PinholeCamera(
        width=len(range(first, camera.width, stride)),
        height=len(range(first, camera.height, stride)),
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=(camera.cx - first) / stride,
        cy=(camera.cy - first) / stride,
    )
    return thin, (first, first)


def _recorded_pixels(
    camera: PinholeCamera, distortion: Sequence[float], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which recorded pixel saw along the ray of each undistorted pixel, -1 where none did."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    rays = camera.rays()[rows, columns]
    seen, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.asarray(distortion, np.float64)
    )
    u, v = np.rint(seen.reshape(*rows.shape, 2)).transpose(2, 0, 1)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    inside &= np.hypot(rays[..., 0], rays[..., 1]) < _validity(distortion, camera.largest_slant())
    return np.where(inside, v, -1).astype(np.int64), np.where(inside, u, -1).astype(np.int64)


def _validity(distortion: Sequence[float], reach: float) -> float:
    """The tangent of the angle off the axis up to which the lens model is one-to-one, at most ``reach``:
    beyond, a polynomial that was fitted to the image turns back and would show its inside once more."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *[0.0] * (8 - len(distortion)))
    r = np.linspace(0.0, reach, 4096)
    bent = r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3))) / (1 + r**2 * (k4 + r**2 * (k5 + r**2 * k6)))
    turns = np.flatnonzero(np.diff(bent) <= 0)
    return float(r[turns[0]]) if len(turns) else float("inf")
