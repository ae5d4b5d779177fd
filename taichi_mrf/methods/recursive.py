"""Recursive maps: maps that integrate each scan when it is added.

A voxel holds one number, its log-odds, and every scan changes it once. The contributions of single scans
cannot be separated afterwards, so after a removal or a move the map is rebuilt from the remaining scans. A
method defines which bricks a scan reaches and how it changes their voxels; this module does the rest.
"""

import dataclasses
import math
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.inference.keyframe import DepthImage, Footprint, checked_depth
from taichi_mrf.inference.schedule import (
    InferProgress,
    InferReport,
    InferSteps,
    Progress,
    StopRequestedError,
    driven,
)
from taichi_mrf.methods.brick_map import BrickMap, check_inference
from taichi_mrf.methods.map_file import (
    MapHeader,
    StoredKeyframe,
    naming,
    open_map_file,
    read_bricks,
    read_header,
)
from taichi_mrf.methods.protocol import MapStatistics, measure
from taichi_mrf.methods.recursive_update import LEAST_LOG_ODDS, UNKNOWN_LOG_ODDS, fade_bricks
from taichi_mrf.queries.survey import Occlusion
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel, warn_of_bad_sigma
from taichi_mrf.sensor.own_evidence import checked_evidence, checked_no_return, free_up_to_m
from taichi_mrf.sensor.pose_doubt import checked_covariance
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_length
from taichi_mrf.voxels.window import Window

FootprintT = TypeVar("FootprintT", bound=Footprint)
MapT = TypeVar("MapT", bound="RecursiveMap[Any]")


@dataclass(frozen=True)
class Scan(Generic[FootprintT]):
    """A scan on the device, ready to be integrated.

    ``cells`` are the bricks of its window that its rays cross, ascending; all of them exist, and
    ``slots`` are their places in the pool.
    """

    image: DepthImage
    T_world_camera: Pose
    footprint: FootprintT
    slots: NDArray[np.int32]

    @property
    def window(self) -> Window:
        """The box of bricks that contains the scan's rays."""
        return self.footprint.window

    @property
    def cells(self) -> NDArray[np.int32]:
        """The bricks that the rays cross, as cells of the window; all are allocated."""
        return self.footprint.crossed


class RecursiveMap(BrickMap, ABC, Generic[FootprintT]):
    """A probabilistic occupancy map that integrates depth images one by one.

    A voxel is unknown until a scan observes it, and from then on free or occupied by the sign of its
    log-odds. Removing or moving a keyframe makes the map stale: queries still return the old values, and the
    next :meth:`infer` integrates all remaining scans again.

    ``view`` casts rays through the map and treats voxels that are unknown or more likely free than occupied
    as empty. The lowest probability of such a map, 0.12, read as an occlusion density (eq. 15 of MRFMap),
    would stop every ray within a metre or two.
    """

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        any_evidence_counts = dataclasses.replace(config.volume, min_evidence=0.0)
        occlusion = Occlusion(unknown=UNKNOWN_LOG_ODDS, empty_below=0.0)
        # Every brick that a ray crosses is allocated, so no observed place is without one.
        self._make_bricks(config, noise, UNKNOWN_LOG_ODDS, UNKNOWN_LOG_ODDS, any_evidence_counts, occlusion)
        self._keyframes: dict[int, StoredKeyframe] = {}
        self._next_id = 0
        self._stale = False
        self._newest_s = -math.inf

    @abstractmethod
    def _reach(self, image: DepthImage, T_world_camera: Pose) -> FootprintT:
        """The bricks that a scan's rays cross; ``surface`` equals ``crossed``, so that all are allocated.
        Raises CapacityError if there is not enough memory."""

    @abstractmethod
    def _integrate(self, scan: Scan[FootprintT]) -> None:
        """Update the log-odds of the voxels that a scan observes (recursive_update.updated)."""

    @property
    def _takes_no_return(self) -> bool:
        """True if pixels that got no return change the map."""
        return False

    @property
    @abstractmethod
    def _scratch_bytes(self) -> int:
        """Bytes of the memory that integration needs besides the voxels."""

    @property
    def keyframes(self) -> Mapping[int, StoredKeyframe]:
        """The keyframes by id, in the order in which they were added."""
        return MappingProxyType(self._keyframes)

    @property
    def stale(self) -> bool:
        """True if, since the voxels were last computed, keyframes were removed or moved, or (with a
        half-life) arrived late."""
        return self._stale

    @property
    def settled(self) -> bool:
        """True if the voxels are up to date with the keyframes."""
        return not self._stale

    def crossed_bricks(self, id: int) -> NDArray[np.int32]:
        """No bricks, (0, 3): all that a scan's rays cross are allocated."""
        self._find(id)
        return np.zeros((0, 3), np.int32)

    def _place_keyframe(
        self, name: str, T_world_camera: Pose, stamp_s: float, depth_m: ArrayLike, camera: Camera, **own: Any
    ) -> None:
        """With a half-life, a scan older than one already added makes the map stale."""
        if own.pop("color") is not None or own.pop("images"):
            raise ConfigError(
                f"a map of the method {self.METHOD.name} has no colours: pass no color or images"
            )
        depth, missing = checked_depth(depth_m, camera, self.sensor.min_depth), own.pop("no_return")
        depth, evidence = checked_evidence(depth, camera, **own)
        missing = checked_no_return(missing, depth_m, camera)
        if missing is not None:  # those that are free up to a depth of their own are for an MRFMap
            missing = without if (without := free_up_to_m(missing) < 0).any() else None
        if self._takes_no_return:
            evidence = dataclasses.replace(evidence, no_return=missing)
        elif missing is not None and self.sensor.no_return != "ignore":
            warnings.warn(
                f"sensor.no_return: {self.sensor.no_return} has no effect: a map of the method "
                f"{self.METHOD.name} ignores {int(missing.sum())} pixels without a return. "
                "Set it to ignore, or map with mrf (free, model) or log_odds (free)",
                stacklevel=3,
            )
        if not self._keyframes:
            table = evidence.noise_model(self.noise, depth).table(camera)
            warn_of_bad_sigma(table, self.sensor.min_depth, self.sensor.max_depth)
        record = StoredKeyframe(self._next_id, name, depth, T_world_camera, camera, stamp_s, own=evidence)
        if not self.config.time.is_static and record.stamp_s < self._newest_s:
            self._stale = True  # it counts less than those that came before it
        if not self._stale:
            self._add(record)
        self._keyframes[record.id] = record

    def remove_keyframe(self, id: int) -> None:
        """Remove a keyframe. Its contribution stays in the map until the next :meth:`infer`."""
        self._find(id)
        del self._keyframes[id]
        self._stale = True

    def move_keyframe(
        self, id: int, T_world_camera: ArrayLike, pose_covariance: ArrayLike | None = None
    ) -> None:
        """Move a keyframe to another pose, (4, 4), with another covariance (6, 6) or the old one. The map
        changes with the next :meth:`infer`."""
        keyframe, T = self._find(id), as_pose(T_world_camera)
        own = keyframe.own
        if pose_covariance is not None:
            own = dataclasses.replace(own, pose_covariance=checked_covariance(pose_covariance))
        self._keyframes[id] = dataclasses.replace(keyframe, T_world_camera=T, own=own)
        self._stale = True

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Rebuild the map if it is stale; otherwise do nothing.

        All scans are integrated again in the order in which they were added or, with a half-life, in order of
        their stamps. The result is the map of these scans alone. ``sweeps``, ``tolerance`` and ``keyframes``
        are arguments of MRFMap.infer; here they are checked and ignored. ``progress`` is called after each
        scan; if it returns False, the map holds the scans so far and stays stale. Raises CapacityError
        if there is not enough memory.
        """
        return driven(self.infer_steps(sweeps, tolerance, keyframes), progress)

    def infer_steps(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
    ) -> InferSteps:
        """:meth:`infer` as a generator, which yields an InferProgress after each scan."""
        for id in check_inference(sweeps, tolerance, keyframes) or ():
            self._find(id)
        begin = time.perf_counter()
        records = list(self._keyframes.values()) if self._stale else []
        if not self.config.time.is_static:
            records.sort(key=lambda record: record.stamp_s)
        if self._stale:
            self._forget_voxels()
        rays, done, complete = 0, 0, True
        try:
            for record in records:
                self._add(record)
                rays, done = rays + record.rays, done + 1
                yield InferProgress(1, 1, done, len(records), record.rays)
        except StopRequestedError:
            complete = False
        self._stale = done < len(records)
        return InferReport(time.perf_counter() - begin, 0.0, int(done > 0), rays, complete)

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """All known voxels of at least this probability: centres (N, 3) in metres, and (N,)."""
        if min_probability == 0.5:
            # Excludes unknown voxels before they are collected: there are far more of them than of others.
            min_probability += 0.2 * LEAST_LOG_ODDS
        centres, p = super().voxels(min_probability)
        known = p != 0.5  # see LEAST_LOG_ODDS
        return centres[known], p[known]

    def statistics(self) -> MapStatistics:
        """The size of the map; ``frozen`` is 0."""
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
        """Zeros, (n,) -> (n, 512): a recursive map does not count the keyframes that observe a voxel."""
        return np.zeros((len(slots), VOXELS), np.uint8)

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file, under a temporary name first. Raises MapFileError."""
        slots = self._pool.in_order
        keyframes = list(self._keyframes.values())
        facts = (self._next_id, self.settled, self.up, self.promise)
        header = MapHeader(self.config, self.noise, keyframes, *facts)
        belief = self._pool.read("belief", slots)
        write_recursive(Path(path), RecursiveContents(header, self._pool.bricks[slots], belief, self._stale))

    @classmethod
    def load(cls: type[MapT], path: str | Path, memory_limit_gb: float | None = None) -> MapT:
        """Read a saved map, which can be queried at once and extended. ``memory_limit_gb`` overrides the
        saved limit. Raises MapFileError, also for a map of another method, or CapacityError if there is not
        enough memory."""
        contents = read_recursive(Path(path), cls.METHOD.name)
        header, bricks = contents.header, contents.bricks
        with naming(Path(path)):
            m = cls.with_noise(header.limited_to(memory_limit_gb), header.noise)
            if len(bricks):
                m._pool.write("total", m._registry.restore(bricks, 1), contents.belief)
        for k in header.keyframes:
            m._keyframes[k.id] = k
        m._next_id, m._stale, m._up = header.next_id, contents.stale, header.up
        m.promise = header.promise
        m._newest_s = max((k.stamp_s for k in header.keyframes), default=-math.inf)
        return m

    def _find(self, id: int) -> StoredKeyframe:
        if id not in self._keyframes:
            raise KeyframeError(f"there is no keyframe {id}")
        return self._keyframes[id]

    def _add(self, record: StoredKeyframe) -> None:
        """Allocate the bricks that a scan's rays cross and integrate it. An error leaves the map
        unchanged."""
        image = DepthImage.upload(record.depth_m, record.camera, self.noise, own=record.own)
        footprint = self._reach(image, record.T_world_camera)
        self._registry.anchor_at(record.T_world_camera[:3, 3])
        slots = self._registry.claim(footprint).slots
        self._fade(record.stamp_s)  # from here on nothing fails
        if len(slots):
            self._integrate(Scan(image, record.T_world_camera, footprint, slots))
            self._pool.revision += 1
            self._pool.touch(slots)
        runtime.settle()  # before the image's arrays are dropped

    def _fade(self, stamp_s: float) -> None:
        """Let the time up to a new scan, the newest, pass for all voxels."""
        forgotten = (
            self.config.time.forgotten(stamp_s - self._newest_s) if self._newest_s > -math.inf else 0.0
        )
        self._newest_s = max(self._newest_s, stamp_s)
        slots = self._pool.in_use
        if forgotten > 0 and len(slots):
            fade_bricks(slots, self._pool.total, forgotten, strip_length())
            self._pool.revision += 1
            self._pool.touch(slots)

    def _forget_voxels(self) -> None:
        """Release all bricks."""
        self._newest_s = -math.inf
        self._pool.release(self._pool.in_use)
        self._pool.revision += 1
        self._registry.topology.clear()
        self._registry.start_over()


@dataclass(frozen=True)
class RecursiveContents:
    """The contents of such a file. ``belief`` (n, 512) are the log-odds of the ``bricks`` (n, 3); ``stale``
    says that keyframes were removed or moved since they were computed."""

    header: MapHeader
    bricks: NDArray[np.int32]
    belief: NDArray[np.float32]
    stale: bool


def write_recursive(path: Path, contents: RecursiveContents) -> None:
    """Write the file under a temporary name and rename it into place. Raises MapFileError."""
    arrays = {
        **contents.header.arrays(),
        "bricks": contents.bricks,
        "belief": contents.belief,
        "stale": np.asarray(contents.stale),
    }
    write_npz(path, arrays, manifest=True)


def read_recursive(path: Path, method: str) -> RecursiveContents:
    """Read a map of a method back. Raises MapFileError, which names the file and what is wrong."""
    with open_map_file(path, method) as file:
        return RecursiveContents(
            read_header(path, file), *read_bricks(path, file), stale=file.scalar("stale", "b")
        )
