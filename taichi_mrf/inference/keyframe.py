"""A keyframe: a depth image, its pose, the bricks that its rays cross, and its messages to their voxels."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera, check_camera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import CameraNoise, NoiseModel
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence
from taichi_mrf.sensor.pose_doubt import Covariance, beside_edges, doubtful_table
from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import Resident, on_host, resident, zeros
from taichi_mrf.system.types import I32, F32Array, I32Array
from taichi_mrf.voxels.layers import pixel_layers
from taichi_mrf.voxels.window import Window

Cells = NDArray[np.int32]


LEAST_DEPTH_M = float(np.finfo(np.float32).smallest_subnormal)
"""The smallest depth that is positive."""


def checked_depth(depth_m: ArrayLike, camera: Camera, min_depth: float) -> NDArray[np.float32]:
    """A copy of (H, W) axial depth in metres, in which what is no measurement is 0: NaN, infinite, not
    positive, or nearer than ``min_depth``.

    Raises KeyframeError if it does not have the camera's shape, or holds no floating-point metres.
    """
    check_camera(camera)
    depth = np.asarray(depth_m)
    if depth.shape != camera.shape:
        raise KeyframeError(
            f"a depth image has the shape {depth.shape}, but the camera has {camera.height} rows and "
            f"{camera.width} columns"
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise KeyframeError(f"a depth image must be floating-point metres, not {depth.dtype}")
    with np.errstate(over="ignore"):
        measured = depth.astype(np.float32, copy=False)
    # NaN is never larger than anything.
    kept = np.where(depth >= max(min_depth, LEAST_DEPTH_M), measured, np.float32(0.0))
    if kept.max(initial=0.0) == np.inf:
        kept[kept == np.inf] = 0.0
    return kept


def checked_images(images: Mapping[str, ArrayLike | None], camera: Camera) -> dict[str, NDArray[np.uint8]]:
    """Copies of images beside depth by name, but for those that are None. Raises KeyframeError for one that
    no layer follows from (voxels/layers.py), of another shape than the camera's, or no uint8."""
    channels, found = {made.image: made.channels for made in pixel_layers().values()}, {}
    for name, given in images.items():
        if name not in channels:
            raise KeyframeError(f"no layer follows from an image {name!r}: there are {', '.join(channels)}")
        if given is not None:
            image, shape = np.asarray(given), (*camera.shape, *([channels[name]] * (channels[name] > 1)))
            if image.shape != shape or image.dtype != np.uint8:
                raise KeyframeError(
                    f"the image {name} must be uint8 of the shape {shape}, not {image.dtype} {image.shape}"
                )
            found[name] = image.copy()
    return found


TILE = 32
"""Pixels along each side of the tiles by which depths are summed up, and in whose order rays are listed:
those of a tile cross the same bricks. A tile is also the largest block of pixels with one ray."""


@dataclass
class DepthImage:
    """A depth image where kernels can reach it, with its camera and the camera's noise.

    ``depth`` is (H * W) float32 in metres along each pixel's ray (axial depth for a pinhole), 0 where there
    is no measurement; ``farthest`` the largest in each tile (rows, columns). ``sensor`` is camera and noise
    as kernels take them, ``rays`` the number of measurements. ``color`` is (H, W, 3) RGB in host memory, 0
    0 0 where a pixel has no colour, or None. ``own`` is what the keyframe states of its measurements.
    If the pose is uncertain, ``certain`` is the image as it was measured.
    """

    depth: Resident
    camera: Camera
    sensor: Sensor
    noise_table: CameraNoise
    rays: int
    farthest: NDArray[np.float32]
    color: NDArray[np.uint8] | None = None
    own: OwnEvidence = NOTHING
    certain: "DepthImage | None" = None

    @staticmethod
    def upload(
        depth_m: NDArray[np.float32],
        camera: Camera,
        noise: NoiseModel,
        color: NDArray[np.uint8] | None = None,
        own: OwnEvidence = NOTHING,
    ) -> "DepthImage":
        """Put :func:`checked_depth` (H, W), which must not change from now on, where kernels can reach it.
        ``noise`` is the map's, for what the keyframe does not state itself. Raises ConfigError if the noise
        model does not fit the camera."""
        pose_covariance, own = own.pose_covariance, replace(own, pose_covariance=None)
        table = own.noise_model(noise, depth_m).table(camera)
        depth, sensor = resident(depth_m.reshape(-1)), table.sensor(camera)
        rays, farthest = int(np.count_nonzero(depth_m)), _farthest(depth_m)
        image = DepthImage(depth, camera, sensor, table, rays, farthest, color, own)
        return image.doubting(pose_covariance)

    def doubting(self, pose_covariance: Covariance | None) -> "DepthImage":
        """Copy of the image from a pose of another covariance (6, 6), None for an exact one: with the noise
        of sensor and pose, and without the pixels that an edge may cross (sensor/pose_doubt.py). Raises
        ConfigError if the noise's sigma cannot be scaled."""
        image = self.at_certain_pose
        if pose_covariance is None:
            return image
        depth_m = np.array(on_host(image.depth)).reshape(image.camera.shape)
        table = doubtful_table(image.noise_table, depth_m, image.camera, pose_covariance)
        depth_m[beside_edges(depth_m, image.camera, pose_covariance)] = 0.0
        return replace(
            image,
            depth=resident(depth_m.reshape(-1)),
            sensor=table.sensor(image.camera),
            noise_table=table,
            rays=int(np.count_nonzero(depth_m)),
            own=replace(image.own, pose_covariance=pose_covariance),
            certain=image,
        )

    @property
    def at_certain_pose(self) -> "DepthImage":
        """The image as it was measured, with the sensor's noise alone."""
        return self if self.certain is None else self.certain

    @property
    def nbytes(self) -> int:
        """Bytes of depth, colour and sigmas, and of rays that no other image shares: those without a pattern
        and those of a moving sensor."""
        color = 0 if self.color is None else self.color.nbytes
        origins = getattr(self.camera, "origins_m", None)
        shared = self.camera.pixels_per_radian > 0 and origins is None
        starts = 0 if origins is None else origins.nbytes
        doubt = 0 if self.certain is None else self.depth.shape[0] * 8
        return self.depth.shape[0] * (4 if shared else 4 + 12) + starts + color + self.own.nbytes + doubt

    def to_numpy(self) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, 0 where there is no measurement."""
        return np.array(on_host(self.at_certain_pose.depth)).reshape(self.camera.shape)


def _farthest(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest of (H, W) depths in each tile, (rows, columns)."""
    height, width = depth_m.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    padded = depth_m
    if (height, width) != (rows * TILE, columns * TILE):
        padded = np.zeros((rows * TILE, columns * TILE), np.float32)
        padded[:height, :width] = depth_m
    # Whole rows first, which is what memory is fast at.
    return padded.reshape(rows, TILE, -1).max(axis=1).reshape(rows, columns, TILE).max(axis=2)


@dataclass(frozen=True)
class RayList(Bundle):
    """The rays of a depth image, group after group, tile after tile. Kernels take it as it is. n and g are at
    least 1."""

    blocks: I32Array
    """(n): which block of pixels each ray stands for (ray_list.block_of)."""

    depth: F32Array
    """(n): each ray's measurement, the mean of its pixels, in metres."""

    last: F32Array
    """(n): the depth at which each ray ends, because its measurement carries no more evidence."""

    number: I32
    """Number of entries that are rays."""

    groups: I32Array
    """(g): which block of pixels each group stands for."""

    first: I32Array
    """(g + 1): the first ray of each group; the next group's first is its end."""

    support: F32Array
    """(g): the depth before which no ray of the group can have met its surface."""

    group_number: I32
    """Number of entries that are groups."""

    widest: I32
    """Largest number of pixels along a group's side."""

    @staticmethod
    def empty(rays: int, groups: int) -> "RayList":
        """A list with room for so many."""
        n, g = max(1, rays), max(1, groups)
        blocks, group_blocks, first = (zeros(np.int32, size) for size in (n, g, g + 1))
        depth, last, support = (zeros(np.float32, size) for size in (n, n, g))
        return RayList(blocks, depth, last, rays, group_blocks, first, support, groups, 1)

    @property
    def nbytes(self) -> int:
        """Bytes of the list."""
        return 12 * (self.blocks.shape[0] + self.groups.shape[0])


@dataclass
class NoReturnRays:
    """The rays of pixels that got no return, of one law (sensor/no_return.py). The depth of their ``image``
    is that up to which they count, at most ``reach_m``, and ``begin_m`` that from which on they do.
    ``is_sure``: what they pass is known to be free, as the space of the robot's own body is."""

    image: DepthImage
    ray_list: RayList
    begin_m: float
    reach_m: float
    is_sure: bool

    @property
    def nbytes(self) -> int:
        """Bytes of the image and of the list of the rays."""
        return self.image.nbytes + self.ray_list.nbytes


@dataclass(frozen=True)
class Footprint:
    """Bricks that a depth image's rays cross, which depend on its pose and on nothing else in the map.

    ``crossed`` are the window's cells (bricks) that any ray crosses, ``surface`` those among them near a
    measured surface, and ``seen`` those of which rays see enough to know that they are free if no surface is
    near, all ascending. ``longest`` bounds the voxels on any one ray, with those on the shared path of its
    group.
    """

    window: Window
    crossed: Cells
    surface: Cells
    seen: Cells
    longest: int


@dataclass(frozen=True)
class BrickArrays:
    """A list of visible bricks where kernels can reach it without the host: cells and slots, and a count for
    each brick of the voxels that moved in the last sweep. (n) int32 each."""

    cells: Resident
    slots: Resident
    moved: Resident


@dataclass
class VisibleBricks:
    """The bricks of the map that a keyframe's rays cross, in the order of its messages.

    ``cells`` in the keyframe's window (ascending), ``slots`` in the pool, ``identity`` shows whether
    that is still the same brick, and ``version`` of the map's set of bricks at which this was true.
    ``arrays`` and the ``scale`` of the accumulators are made when a sweep first needs them.
    """

    cells: Cells
    slots: NDArray[np.int32]
    identity: NDArray[np.int64]
    version: int
    arrays: BrickArrays | None = None
    scale: float = 0.0

    def on_device(self) -> BrickArrays:
        """The list on the device; it must not be empty."""
        if self.arrays is None:
            moved = zeros(np.int32, len(self.slots))
            self.arrays = BrickArrays(resident(self.cells), resident(self.slots), moved)
        return self.arrays


@dataclass
class Keyframe:
    """One keyframe of a map.

    ``stamp_s`` is when it was taken, in seconds. ``messages`` is (bricks * 512) log-odds, in the order of
    ``visible``. ``revision`` is that of the beliefs right after its last sweep, and
    ``pending_visible`` what the keyframe sees now, if its messages are still those of ``visible``.
    ``change_count_at_last_sweep`` (bricks that it sees now) is how often marginals of each had changed by
    its last sweep.
    ``no_returns`` are the rays of pixels that got no return, if they count.
    """

    id: int
    name: str
    image: DepthImage
    ray_list: RayList
    T_world_camera: Pose
    stamp_s: float
    footprint: Footprint
    visible: VisibleBricks
    revision: int = -1
    messages: ti.Ndarray | None = None
    change_count_at_last_sweep: NDArray[np.int64] | None = None
    pending_visible: VisibleBricks | None = None
    no_returns: tuple[NoReturnRays, ...] = ()
    withdrawn: bool = False

    @property
    def camera(self) -> Camera:
        """The camera that took its image."""
        return self.image.camera

    @property
    def rays(self) -> int:
        """Number of pixels that hold a measurement."""
        return self.image.at_certain_pose.rays

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, 0 where there is no measurement."""
        return self.image.to_numpy()

    @property
    def color(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) RGB, 0 0 0 where a pixel has no colour; None without a colour image."""
        return self.image.color

    @property
    def own(self) -> OwnEvidence:
        """Evidence that it states of its own measurements."""
        return self.image.own

    def beside(self, image: str) -> NDArray[np.uint8] | None:
        """The image beside depth that a layer follows from (layers.FromPixels), None without one."""
        return self.color if image == "color" else self.own.images.get(image)

    @property
    def image_bytes(self) -> int:
        """Bytes of the images and of the lists of the rays."""
        return self.image.nbytes + self.ray_list.nbytes + sum(each.nbytes for each in self.no_returns)

    @property
    def voxel_bytes(self) -> int:
        """Bytes of messages and lists, which grow with the voxels that this keyframe sees."""
        width = 4 if self.messages is not None and self.messages.dtype == ti.f32 else 2
        messages = 0 if self.messages is None else self.messages.shape[0] * width
        lists = (self.footprint.crossed, self.footprint.surface, self.visible.cells, self.visible.slots)
        return messages + sum(a.nbytes for a in lists) + self.visible.identity.nbytes
