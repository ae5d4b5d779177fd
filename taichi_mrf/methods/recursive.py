"""Maps that integrate each scan when it is added: what the methods other than MRFMap have in common.

A voxel of such a map holds one number, its log-odds, which every scan changes once. Scans cannot be told
apart in it any more, so none can be taken back: after a removal or a move the map is made anew from the
scans that are left. A method says which bricks a scan reaches and how the scan changes their voxels;
the books are kept here.
"""

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import instance
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.inference.keyframe import DepthImage, Footprint, checked_depth
from taichi_mrf.inference.schedule import InferProgress, InferReport, Progress
from taichi_mrf.methods.brick_map import BrickMap, check_inference
from taichi_mrf.methods.map_file import MapHeader, StoredKeyframe, naming
from taichi_mrf.methods.recursive_storage import RecursiveContents, read_recursive, write_recursive
from taichi_mrf.methods.recursive_update import LEAST_LOG_ODDS, UNKNOWN_LOG_ODDS
from taichi_mrf.methods.statistics import MapStatistics, measure
from taichi_mrf.queries.occlusion import Occlusion
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel, warn_of_bad_sigma
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.window import Window

FootprintT = TypeVar("FootprintT", bound=Footprint)
MapT = TypeVar("MapT", bound="RecursiveMap[Any]")


@dataclass(frozen=True)
class ScanRecord:
    """A scan as the map keeps it, in the host's memory: what is needed to integrate it once more.

    ``depth_m`` is (H, W) float32 axial depth in metres, 0 where there is no measurement.
    """

    id: int
    name: str
    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: Camera

    @property
    def rays(self) -> int:
        """Number of pixels that hold a measurement."""
        return int((self.depth_m > 0).sum())

    @property
    def image_bytes(self) -> int:
        """Bytes of the depth image."""
        return self.depth_m.nbytes


@dataclass(frozen=True)
class Scan(Generic[FootprintT]):
    """A scan that is about to be integrated, where kernels reach it.

    ``cells`` are the bricks of its window that its rays cross, ascending; all of them exist, and
    ``slots`` are their places in the pool.
    """

    image: DepthImage
    T_world_camera: Pose
    footprint: FootprintT
    slots: NDArray[np.int32]

    @property
    def window(self) -> Window:
        """The box of bricks that the scan looks at."""
        return self.footprint.window

    @property
    def cells(self) -> NDArray[np.int32]:
        """The bricks that exist and are crossed, as cells of the window."""
        return self.footprint.crossed


class RecursiveMap(BrickMap, ABC, Generic[FootprintT]):
    """A probabilistic occupancy map that integrates one depth image after the other.

    A voxel is unknown until the first scan says something of it, and free or occupied from then on, by
    the sign of its log-odds. Removing or moving a keyframe leaves the map stale: queries still answer
    with what is known, and the next :meth:`infer` integrates all scans that are left anew.

    ``view`` follows rays through the map. They pass voxels that are unknown or more likely free than
    occupied as if these were empty: such a map says of free space "0.12 at the least", which read as a
    medium (eq. 15 of MRFMap) would stop every ray within a metre or two.
    """

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        any_evidence_counts = dataclasses.replace(config.volume, min_evidence=0.0)
        occlusion = Occlusion(unknown=UNKNOWN_LOG_ODDS, empty_below=0.0)
        # Every brick that was seen exists, so no place is seen and has none.
        self._make_bricks(config, noise, UNKNOWN_LOG_ODDS, UNKNOWN_LOG_ODDS, any_evidence_counts, occlusion)
        self._keyframes: dict[int, ScanRecord] = {}
        self._next_id = 0
        self._stale = False

    @abstractmethod
    def _reach(self, image: DepthImage, T_world_camera: Pose) -> FootprintT:
        """The bricks that a scan's rays cross: ``surface`` the same as ``crossed``, because all of them
        are to exist. Raises CapacityError if there are too many."""

    @abstractmethod
    def _integrate(self, scan: Scan[FootprintT]) -> None:
        """Change the log-odds of the voxels that a scan says something of (recursive_update.updated)."""

    @property
    @abstractmethod
    def _scratch_bytes(self) -> int:
        """Bytes that integration holds beside the voxels."""

    @property
    def keyframes(self) -> Mapping[int, ScanRecord]:
        """The keyframes by id, in the order in which they were added."""
        return MappingProxyType(self._keyframes)

    @property
    def stale(self) -> bool:
        """Whether keyframes were removed or moved since the voxels were last worked out."""
        return self._stale

    @property
    def settled(self) -> bool:
        """Whether the voxels are those that the keyframes give."""
        return not self._stale

    def crossed_bricks(self, id: int) -> NDArray[np.int32]:
        """No brick, (0, 3): all that a scan's rays cross exist."""
        self._find(id)
        return np.zeros((0, 3), np.int32)

    def add_keyframe(
        self, depth_m: ArrayLike, T_world_camera: ArrayLike, camera: Camera, name: str = ""
    ) -> int:
        """Add a depth image and integrate it at once (in a stale map with the next :meth:`infer`).

        ``depth_m`` is (H, W) axial depth in metres, where 0, NaN and negative mean no measurement;
        ``T_world_camera`` is (4, 4). Returns the keyframe's id.
        Raises KeyframeError for a wrong shape or pose, CapacityError if the map would not fit.
        """
        T, name = as_pose(T_world_camera), instance(name, str, "name", "a string")
        depth = checked_depth(depth_m, camera, self.sensor.min_depth)
        if not self._keyframes:
            warn_of_bad_sigma(self.noise.table(camera), self.sensor.min_depth, self.sensor.max_depth)
        record = ScanRecord(self._next_id, name or f"keyframe {self._next_id}", depth, T, camera)
        if not self._stale:
            self._add(record)
        self._keyframes[record.id] = record
        self._next_id += 1
        return record.id

    def remove_keyframe(self, id: int) -> None:
        """Take a keyframe out. What it has said stays in the map until the next :meth:`infer`."""
        self._find(id)
        del self._keyframes[id]
        self._stale = True

    def move_keyframe(self, id: int, T_world_camera: ArrayLike) -> None:
        """Give a keyframe another pose, which the map follows with the next :meth:`infer`."""
        self._keyframes[id] = dataclasses.replace(self._find(id), T_world_camera=as_pose(T_world_camera))
        self._stale = True

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Bring the map up to date: nothing to do, unless keyframes were removed or moved.

        Then all scans are integrated anew, in the order in which they were added, and the map is the one
        that these scans alone give. ``sweeps``, ``tolerance`` and ``keyframes`` are those of
        MRFMap.infer and change nothing here. ``progress`` is called after each scan; returning False
        stops, and leaves a map of the scans up to there that is still stale.
        Raises CapacityError if the map would not fit.
        """
        for id in check_inference(sweeps, tolerance, keyframes) or ():
            self._find(id)
        begin = time.perf_counter()
        records = list(self._keyframes.values()) if self._stale else []
        if self._stale:
            self._forget_voxels()
        rays, done, complete = 0, 0, True
        for record in records:
            self._add(record)
            rays, done = rays + record.rays, done + 1
            if progress is not None and not progress(InferProgress(1, 1, done, len(records), record.rays)):
                complete = False
                break
        self._stale = done < len(records)
        return InferReport(time.perf_counter() - begin, 0.0, int(done > 0), rays, complete)

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """All known voxels of at least this probability: centres (N, 3) in metres, and (N,)."""
        if min_probability == 0.5:
            # Leaves the unknown out before they are collected: there are far more of them than others.
            min_probability += 0.2 * LEAST_LOG_ODDS
        centres, p = super().voxels(min_probability)
        known = p != 0.5  # LEAST_LOG_ODDS sees to that
        return centres[known], p[known]

    def statistics(self) -> MapStatistics:
        """How large the map is; no keyframe is ever frozen."""
        keyframes = self._keyframes.values()
        return measure(
            self._pool,
            keyframes=len(keyframes),
            frozen=0,
            rays=sum(k.rays for k in keyframes),
            message_bytes=0,
            other_bytes=sum(k.image_bytes for k in keyframes) + self._scratch_bytes,
        )

    def seen_by(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """How many keyframes see each voxel of some bricks of the pool, (n,) -> (n, 512): such a map does not
        remember it, and says 0."""
        return np.zeros((len(slots), VOXELS), np.uint8)

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file, beside it first and then into place. Raises MapFileError."""
        slots = self._pool.in_order
        keyframes = [
            StoredKeyframe(k.id, k.name, k.depth_m, k.T_world_camera, k.camera)
            for k in self._keyframes.values()
        ]
        header = MapHeader(self.config, self.noise, keyframes, self._next_id, self.settled)
        belief = self._pool.read("belief", slots)
        write_recursive(Path(path), RecursiveContents(header, self._pool.bricks[slots], belief, self._stale))

    @classmethod
    def load(cls: type[MapT], path: str | Path, memory_limit_gb: float | None = None) -> MapT:
        """Read a map that can be queried at once and extended; ``memory_limit_gb`` takes the place of its
        own. Raises MapFileError, also for a map of another method, or CapacityError if there is no room."""
        contents = read_recursive(Path(path), cls.METHOD.name)
        header, bricks = contents.header, contents.bricks
        with naming(Path(path)):
            m = cls.with_noise(header.limited_to(memory_limit_gb), header.noise)
            if len(bricks):
                m._pool.write("belief", m._registry.restore(bricks, 1), contents.belief)
        for k in header.keyframes:
            m._keyframes[k.id] = ScanRecord(k.id, k.name, k.depth_m, k.T_world_camera, k.camera)
        m._next_id, m._stale = header.next_id, contents.stale
        return m

    def _find(self, id: int) -> ScanRecord:
        if id not in self._keyframes:
            raise KeyframeError(f"there is no keyframe {id}")
        return self._keyframes[id]

    def _add(self, record: ScanRecord) -> None:
        """Allocate what a scan's rays cross and integrate it; what is raised leaves the map as it was."""
        image = DepthImage.upload(record.depth_m, record.camera, self.noise)
        footprint = self._reach(image, record.T_world_camera)
        self._registry.anchor_at(record.T_world_camera[:3, 3])
        self._registry.claim(footprint)
        slots = self._registry.visible(footprint).slots
        if len(slots):
            self._integrate(Scan(image, record.T_world_camera, footprint, slots))
            self._pool.revision += 1
            self._pool.touch(slots)
        runtime.settle()  # before the image's arrays are dropped

    def _forget_voxels(self) -> None:
        """Give all bricks back."""
        self._pool.release(self._pool.in_use)
        self._pool.revision += 1
        self._registry.topology.clear()
        self._registry.start_over()
