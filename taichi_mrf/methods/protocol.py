"""The interface of all maps: what the rest of the program uses, whatever the method."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.schedule import InferReport, InferSteps, Progress
from taichi_mrf.queries.view import RayProfile
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.own_evidence import OwnEvidence
from taichi_mrf.voxels.layout import CHUNK, VOXELS
from taichi_mrf.voxels.pool import BrickPool

if TYPE_CHECKING:
    from taichi_mrf.inference.keyframe import Keyframe
    from taichi_mrf.methods.map_file import StoredKeyframe
    from taichi_mrf.queries.free import FreePromise


@dataclass(frozen=True)
class MapStatistics:
    """The size of a map. ``memory_mb`` counts voxels, messages, images and scratch memory;
    ``bytes_per_voxel`` what grows with the voxels: their channels and all keyframes' messages."""

    keyframes: int
    frozen: int
    rays: int
    bricks: int
    voxels: int
    chunks: int
    memory_mb: float
    bytes_per_voxel: float


def measure(
    pool: BrickPool, *, keyframes: int, frozen: int, rays: int, message_bytes: int, other_bytes: int
) -> MapStatistics:
    """The statistics of a map; ``message_bytes`` is the memory of all messages, ``other_bytes`` what does not
    grow with the voxels."""
    in_use = pool.in_use
    voxels = len(in_use) * VOXELS
    of_voxels = pool.capacity * VOXELS * pool.bytes_per_voxel + message_bytes
    return MapStatistics(
        keyframes=keyframes,
        frozen=frozen,
        rays=rays,
        bricks=len(in_use),
        voxels=voxels,
        chunks=len(np.unique(pool.bricks[in_use] // CHUNK, axis=0)),
        memory_mb=(of_voxels + other_bytes) / 1e6,
        bytes_per_voxel=of_voxels / max(voxels, 1),
    )


class PosedDepth(Protocol):
    """A depth image with its pose: a keyframe of a map, or a frame. Depth is (H, W) axial depth in metres, 0
    for no measurement."""

    @property
    def name(self) -> str: ...
    @property
    def T_world_camera(self) -> Pose: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def depth_m(self) -> NDArray[np.float32]: ...
    @property
    def own(self) -> OwnEvidence:
        """Evidence that it states of its own measurements."""
        ...


class OccupancyMap(VoxelMap, Protocol):
    """A probabilistic occupancy map of depth keyframes, whatever its method.

    Until :meth:`infer`, queries after a change return what was computed before.
    """

    METHOD: ClassVar[Method]
    """The method's entry, which says what else the map can do (capabilities.py)."""

    @property
    def keyframes(self) -> "Mapping[int, Keyframe | StoredKeyframe]": ...

    @property
    def stale(self) -> bool:
        """True if recent removals and moves take effect only with the next :meth:`infer`."""
        ...

    promise: "FreePromise | None"
    """Bounds for the levels of free space, from frames that the map has not seen (queries.free)."""

    @property
    def settled(self) -> bool:
        """True if a full :meth:`infer` would leave the map as it is."""
        ...

    def crossed_bricks(self, id: int) -> NDArray[np.int32]:
        """The bricks that a keyframe's rays cross, (n, 3). Empty if the method allocates all crossed
        bricks."""
        ...

    def add(self, frame: Frame) -> int:
        """Add a frame of a recording as a keyframe; returns its id."""
        ...

    def add_keyframe(
        self,
        depth_m: ArrayLike,
        T_world_camera: ArrayLike,
        camera: Camera,
        name: str = "",
        stamp_s: float | None = None,
        color: ArrayLike | None = None,
        noise: NoiseModel | None = None,
        sigma_m: ArrayLike | None = None,
        no_return: ArrayLike | None = None,
        pose_covariance: ArrayLike | None = None,
        images: Mapping[str, ArrayLike] | None = None,
    ) -> int:
        """Add a depth image as a keyframe; returns its id. For the arguments see BrickMap.add_keyframe."""
        ...

    def remove_keyframe(self, id: int) -> None:
        """Remove a keyframe. Raises KeyframeError if there is none of this id."""
        ...

    def move_keyframe(
        self, id: int, T_world_camera: ArrayLike, pose_covariance: ArrayLike | None = None
    ) -> None:
        """Move a keyframe to another pose, (4, 4), with another covariance (6, 6) or the old one. Raises
        KeyframeError."""
        ...

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Compute the map of all keyframes. ``progress`` is called after each; returning False stops."""
        ...

    def infer_steps(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
    ) -> InferSteps:
        """:meth:`infer` as a generator, which yields after each keyframe. Between two steps the map may be
        queried but not changed."""
        ...

    def ray_profile(
        self, origin: ArrayLike, direction: ArrayLike, max_range: float | None = None
    ) -> RayProfile:
        """Occupancy, visibility and omega along a ray, by range in metres."""
        ...

    def statistics(self) -> MapStatistics:
        """The size of the map."""
        ...

    def seen_by(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Number of keyframes that observe each voxel of bricks of ``view.pool``, (n,) slots -> (n, 512).
        Zeros if the method does not store it."""
        ...

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file. Raises MapFileError."""
        ...
