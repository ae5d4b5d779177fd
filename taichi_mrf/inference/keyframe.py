"""A keyframe: a depth image, where it was taken, which bricks it touches, and what it says of them."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.errors import KeyframeError
from taichi_mrf.poses import Pose
from taichi_mrf.sensor.noise import NoiseModel, NoiseTable
from taichi_mrf.voxels.window import Window

Cells = NDArray[np.int32]


def checked_depth(depth_m: ArrayLike, camera: PinholeCamera, min_depth: float) -> NDArray[np.float32]:
    """A copy of (H, W) axial depth in metres, in which what is no measurement is 0: NaN, infinite, not
    positive, or nearer than ``min_depth``.

    Raises KeyframeError if it does not have the camera's shape, or holds no floating-point metres.
    """
    depth = np.asarray(depth_m)
    if depth.shape != camera.shape:
        raise KeyframeError(
            f"a depth image has the shape {depth.shape}, but the camera has {camera.height} rows and "
            f"{camera.width} columns"
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise KeyframeError(f"a depth image must be floating-point metres, not {depth.dtype}")
    valid = np.isfinite(depth) & (depth >= min_depth) & (depth > 0)
    return np.where(valid, depth, 0.0).astype(np.float32)


@dataclass
class DepthImage:
    """A depth image where kernels can reach it, with its camera and the camera's noise.

    ``depth`` is (H * W) float32 axial depth in metres, 0 where there is no measurement.
    """

    depth: ti.Ndarray
    camera: PinholeCamera
    noise: ti.Ndarray
    noise_table: NoiseTable
    rays: int

    @staticmethod
    def upload(depth_m: NDArray[np.float32], camera: PinholeCamera, noise: NoiseModel) -> "DepthImage":
        """Put :func:`checked_depth` (H, W) on the device. Raises ConfigError if the noise model does not
        fit the camera."""
        table = noise.table(camera)
        depth = ti.ndarray(ti.f32, depth_m.size)
        depth.from_numpy(depth_m.reshape(-1))
        coefficients = ti.ndarray(ti.f32, table.coefficients.shape)
        coefficients.from_numpy(table.coefficients)
        return DepthImage(depth, camera, coefficients, table, int((depth_m > 0).sum()))

    def to_numpy(self) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, 0 where there is no measurement."""
        return self.depth.to_numpy().reshape(self.camera.shape)

    @property
    def intrinsics(self) -> ti.Vector:
        """(fx, fy, cx, cy) as a kernel argument."""
        c = self.camera
        return ti.Vector([c.fx, c.fy, c.cx, c.cy], ti.f32)


@dataclass(frozen=True)
class RayList:
    """The rays of a depth image, tile after tile.

    ``blocks`` (n) int32 says which pixels a ray stands for (ray_list.py), ``depth`` (n) float32 is its
    measurement, axial depth in metres. There is at least one entry; ``number`` of them are rays. ``widest``
    is the largest number of pixels along a block's side.
    """

    blocks: ti.Ndarray
    depth: ti.Ndarray
    number: int
    widest: int

    @property
    def nbytes(self) -> int:
        """Bytes of the list."""
        return 8 * self.blocks.shape[0]


@dataclass(frozen=True)
class Footprint:
    """What a depth image's rays cross, which depends on its pose and on nothing else in the map.

    ``crossed`` are the window's cells (bricks) that any ray crosses, ``surface`` those among them near a
    measured surface, both ascending. ``longest`` bounds the voxels on any one ray.
    """

    window: Window
    crossed: Cells
    surface: Cells
    longest: int


@dataclass
class VisibleBricks:
    """The bricks of the map that a keyframe's rays cross, in the order of its messages.

    ``cells`` in the keyframe's window (ascending), ``slots`` in the pool, ``identity`` to tell whether
    that is still the same brick, and ``version`` of the map's set of bricks at which this was true.
    """

    cells: Cells
    slots: NDArray[np.int32]
    identity: NDArray[np.int64]
    version: int


@dataclass
class Keyframe:
    """One keyframe of a map.

    ``messages`` is (bricks * 512) log-odds, in the order of ``visible``; ``begins`` is, for each ray of the
    list, the depth up to which it crosses none of these bricks, once it is known; ``revision`` is that of
    the beliefs right after its last sweep, and ``heard`` (bricks) how often marginals of each brick had moved
    by then. ``coming`` is what the keyframe sees now, if its messages are still those of ``visible``.
    """

    id: int
    name: str
    image: DepthImage
    ray_list: RayList
    T_world_camera: Pose
    footprint: Footprint
    visible: VisibleBricks
    begins: ti.Ndarray
    begins_known: bool = False
    revision: int = -1
    messages: ti.Ndarray | None = None
    heard: NDArray[np.int64] | None = None
    coming: VisibleBricks | None = None

    @property
    def camera(self) -> PinholeCamera:
        return self.image.camera

    @property
    def rays(self) -> int:
        """Number of pixels that hold a measurement."""
        return self.image.rays

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, 0 where there is no measurement."""
        return self.image.to_numpy()

    @property
    def image_bytes(self) -> int:
        """Bytes of the depth image and of the list of its rays."""
        return self.image.depth.shape[0] * 4 + self.ray_list.nbytes + self.begins.shape[0] * 4

    @property
    def voxel_bytes(self) -> int:
        """Bytes of messages and lists, which grow with the voxels that this keyframe sees."""
        width = 4 if self.messages is not None and self.messages.dtype == ti.f32 else 2
        messages = 0 if self.messages is None else self.messages.shape[0] * width
        lists = (self.footprint.crossed, self.footprint.surface, self.visible.cells, self.visible.slots)
        return messages + sum(a.nbytes for a in lists) + self.visible.identity.nbytes
