"""The map: keyframes go in, marginal probabilities of occupancy come out.

MRFMap (Shankar & Michael, RSS 2020) as an object. It keeps the books: which bricks exist and who owns
them, which keyframes see them. The computation itself is inference/sum_product.py.
"""

import math
import weakref
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from taichi_mrf import runtime
from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import Config, InferenceConfig, SensorConfig, VolumeConfig, overridden
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.inference import sum_product
from taichi_mrf.inference.footprint import find_footprint
from taichi_mrf.inference.keyframe import DepthImage, Footprint, Keyframe
from taichi_mrf.inference.schedule import InferReport, Progress, content_key, run_sweeps
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.inference.visible import find_visible, new_messages
from taichi_mrf.poses import as_pose
from taichi_mrf.queries.extract import extract_voxels
from taichi_mrf.queries.points import classify, point_log_odds, probability
from taichi_mrf.queries.view import RayProfile, View
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise, noise_from_config, warn_of_bad_sigma
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import create_topology, recycle


@dataclass(frozen=True)
class MapStatistics:
    """How large a map is. ``memory_mb`` counts its voxels, messages, images and scratch."""

    keyframes: int
    frozen: int
    rays: int
    bricks: int
    voxels: int
    chunks: int
    memory_mb: float
    bytes_per_voxel: float


class MRFMap:
    """A probabilistic occupancy map of any set of depth keyframes.

    Keyframes can be added, removed, moved and frozen in any order; after :meth:`infer` the map is the
    one that the final set gives. Between changes and :meth:`infer`, queries answer with what is known.
    """

    def __init__(
        self,
        voxel_size: float = 0.05,
        noise: NoiseModel | None = None,
        *,
        inference: InferenceConfig | None = None,
        volume: VolumeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of InferenceConfig, such as ``surface_density=2.1`` or ``prior=0.1``.

        ``noise`` defaults to a Kinect 1. Raises ConfigError for an unknown or impossible parameter.
        """
        runtime.init()
        self.sensor = SensorConfig(min_depth=min_depth, max_depth=max_depth)
        inference = overridden(inference or InferenceConfig(), parameters, "MRFMap")
        self.config = Config(voxel_size, self.sensor, inference, volume=volume or VolumeConfig())
        self.noise = noise if noise is not None else PolynomialNoise(self.sensor.sigma, self.sensor.bias)
        self.voxel_size = self.config.voxel_size
        self.prior = prior_probability(inference, self.voxel_size)
        prior_log_odds = math.log(self.prior / (1 - self.prior))
        self._pool = BrickPool(prior_log_odds, self.config.volume.memory_limit_gb)
        self._topology = create_topology(runtime.active() or "cpu", self.config.volume.dense_bricks)
        weakref.finalize(self, recycle, self._topology)
        self._sweeper = Sweeper(self.voxel_size, self.sensor, inference, self.config.volume)
        self._view = View(self._pool, self.voxel_size, self.config.volume)
        self._keyframes: dict[int, Keyframe] = {}
        self._frozen: dict[int, str] = {}
        self._next_id = 0
        self._version = 0  # of the set of bricks
        self._messages_lost = False  # a loaded map has beliefs, but no messages

    @classmethod
    def from_config(cls, config: Config, camera: PinholeCamera) -> "MRFMap":
        """A map with a configuration's parameters; ``camera`` is what its noise tables must fit."""
        return cls(
            config.voxel_size,
            noise_from_config(config.sensor, camera),
            inference=config.inference,
            volume=config.volume,
            min_depth=config.sensor.min_depth,
            max_depth=config.sensor.max_depth,
        )

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes that can still be moved and removed, by id."""
        return MappingProxyType(self._keyframes)

    @property
    def frozen(self) -> Mapping[int, str]:
        """Names of the keyframes that have been frozen, by id."""
        return MappingProxyType(self._frozen)

    def add_keyframe(
        self, depth_m: ArrayLike, T_world_camera: ArrayLike, camera: PinholeCamera, name: str = ""
    ) -> int:
        """Add a depth image; it takes part from the next :meth:`infer` on.

        ``depth_m`` is (H, W) axial depth in metres, where 0, NaN and negative mean no measurement;
        ``T_world_camera`` is (4, 4). Returns the keyframe's id.
        Raises KeyframeError for a wrong shape or pose, CapacityError if the map would not fit.
        """
        T = as_pose(T_world_camera)
        image = self._upload(depth_m, camera)
        keyframe = self._place(self._next_id, name or f"keyframe {self._next_id}", image, T)
        self._keyframes[keyframe.id] = keyframe
        self._next_id += 1
        return keyframe.id

    def remove_keyframe(self, id: int) -> None:
        """Take a keyframe out, with all that it has said, and the bricks that only it wanted."""
        keyframe = self._find(id)
        self._restore_messages()
        self._take_out(keyframe)
        del self._keyframes[id]

    def move_keyframe(self, id: int, T_world_camera: ArrayLike) -> None:
        """Give a keyframe another pose, as a SLAM back-end does; its messages begin anew."""
        keyframe = self._find(id)
        T = as_pose(T_world_camera)
        self._restore_messages()
        self._take_out(keyframe)
        try:
            self._keyframes[id] = self._place(id, keyframe.name, keyframe.image, T)
        except Exception:
            self._keyframes[id] = self._place(id, keyframe.name, keyframe.image, keyframe.T_world_camera)
            raise

    def freeze_keyframe(self, id: int) -> None:
        """Fold a keyframe's messages into what inference starts from, and forget its image.

        It can be neither moved nor removed any more, and costs neither time nor memory. What it saw of
        bricks that do not exist yet is lost, but for their being free.
        """
        keyframe = self._find(id)
        self._restore_messages()
        if keyframe.messages is None:
            raise KeyframeError(
                f"keyframe {id} ({keyframe.name}) has no messages to freeze: call infer first"
            )
        if len(keyframe.visible.slots):
            self._refresh(keyframe)
            sum_product.fold(keyframe.visible.slots, self._pool.keep_evidence(), keyframe.messages)
        self._frozen[id] = keyframe.name
        del self._keyframes[id]

    def infer(
        self,
        sweeps: int | None = None,
        tolerance: float | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Progress | None = None,
    ) -> InferReport:
        """Compute the marginals by loopy belief propagation.

        Without ``keyframes`` all of them are swept, from no messages and in an order that depends on
        what they hold: the map is a function of the set of keyframes. With ``keyframes`` (ids) only
        those are renewed, starting from what is known, which costs no more than they do.
        ``progress`` is called after each keyframe and stops inference by returning False.
        """
        config = self.config.inference
        sweeps = config.sweeps if sweeps is None else sweeps
        tolerance = config.tolerance if tolerance is None else tolerance
        if keyframes is None:
            chosen = sorted(self._keyframes.values(), key=content_key)
            self._pool.restart()
            for keyframe in chosen:
                keyframe.messages = None
                self._refresh(keyframe)
            self._messages_lost = False
        else:
            chosen = [self._find(id) for id in keyframes]
            self._restore_messages()
            for keyframe in chosen:
                self._refresh(keyframe)
        return run_sweeps(chosen, self._pool, self._sweeper, sweeps, tolerance, progress)

    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Marginal probability of occupied at (N, 3) points in metres, (N,) float32; the prior where
        nobody has looked."""
        return probability(self._log_odds(points))

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED at (N, 3) points in metres, (N,) int8."""
        return classify(self._log_odds(points), self._pool.prior_log_odds, self.config.volume.min_evidence)

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """All allocated voxels of at least this probability: centres (N, 3) in metres, and (N,)."""
        return extract_voxels(self._pool, self.voxel_size, min_probability)

    def render_depth(self, camera: PinholeCamera, T_world_camera: ArrayLike) -> NDArray[np.float32]:
        """Axial depth of the likeliest surface seen by each pixel, (H, W) float32, NaN where none is."""
        return self._view.render_depth(camera, as_pose(T_world_camera), self.sensor.max_depth)

    def ray_profile(
        self, origin: ArrayLike, direction: ArrayLike, max_range: float | None = None
    ) -> RayProfile:
        """Occupancy, visibility and omega (eqs. 15 to 18) along a ray, by range in metres."""
        return self._view.ray_profile(origin, direction, max_range or self.sensor.max_depth)

    def statistics(self) -> MapStatistics:
        """How large the map is."""
        in_use = self._pool.in_use
        voxels = len(in_use) * VOXELS
        held = sum(k.nbytes for k in self._keyframes.values())
        total = self._pool.capacity * VOXELS * self._pool.bytes_per_voxel + held + self._sweeper.nbytes
        return MapStatistics(
            keyframes=len(self._keyframes),
            frozen=len(self._frozen),
            rays=sum(k.rays for k in self._keyframes.values()),
            bricks=len(in_use),
            voxels=voxels,
            chunks=len(np.unique(self._pool.bricks[in_use] // BRICK, axis=0)),
            memory_mb=total / 1e6,
            bytes_per_voxel=total / max(voxels, 1),
        )

    def save(self, path: str | Path) -> None:
        """Write the map to one .npz file, beside it first and then into place. Raises MapFileError."""
        from taichi_mrf.maps.storage import save_map

        save_map(self, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> "MRFMap":
        """Read a map that can be queried at once and extended. Raises MapFileError."""
        from taichi_mrf.maps.storage import load_map

        return load_map(Path(path))

    def _log_odds(self, points: ArrayLike) -> NDArray[np.float32]:
        seen_free = self._pool.prior_log_odds - self.config.inference.message_clamp
        return point_log_odds(points, self.voxel_size, self._topology, self._pool, seen_free)

    def _find(self, id: int) -> Keyframe:
        if id in self._frozen:
            raise KeyframeError(f"keyframe {id} ({self._frozen[id]}) is frozen")
        if id not in self._keyframes:
            raise KeyframeError(f"there is no keyframe {id}")
        return self._keyframes[id]

    def _upload(self, depth_m: ArrayLike, camera: PinholeCamera) -> DepthImage:
        """Check a depth image and put it where kernels reach it; what is no measurement becomes 0."""
        depth = np.asarray(depth_m)
        if depth.shape != camera.shape:
            raise KeyframeError(
                f"a depth image has the shape {depth.shape}, but the camera has {camera.height} rows and "
                f"{camera.width} columns"
            )
        if not np.issubdtype(depth.dtype, np.floating):
            raise KeyframeError(f"a depth image must be floating-point metres, not {depth.dtype}")
        valid = np.isfinite(depth) & (depth >= self.sensor.min_depth) & (depth > 0)
        clean = np.where(valid, depth, 0.0).astype(np.float32)
        table = self.noise.table(camera)
        if not self._keyframes:
            warn_of_bad_sigma(table, self.sensor.min_depth, self.sensor.max_depth)
        device_depth = ti.ndarray(ti.f32, depth.size)
        device_depth.from_numpy(clean.reshape(-1))
        noise = ti.ndarray(ti.f32, table.coefficients.shape)
        noise.from_numpy(table.coefficients)
        return DepthImage(device_depth, camera, noise, table, int(valid.sum()))

    def _place(self, id: int, name: str, image: DepthImage, T_world_camera: NDArray[np.float64]) -> Keyframe:
        """Find a keyframe's bricks, allocate those that are missing, and count its crossings."""
        footprint = find_footprint(
            image, T_world_camera, self.voxel_size, self.sensor, self.config.inference, self.config.volume
        )
        crossed = footprint.window.bricks_of(footprint.crossed)
        camera_brick = np.floor(T_world_camera[:3, 3] / (self.voxel_size * BRICK))
        self._topology.anchor(np.clip(camera_brick, -(2**30), 2**30).astype(np.int32))
        self._topology.check(crossed, self.voxel_size)
        surface = footprint.window.bricks_of(footprint.surface)
        slots = self._topology.slots(surface)
        missing = slots < 0
        if missing.any():
            slots[missing] = self._pool.allocate(surface[missing])
            self._topology.insert(surface[missing], slots[missing])
            self._version += 1
        self._pool.owners[slots] += 1
        self._topology.add_crossings(crossed, 1)
        visible = find_visible(footprint, self._topology, self._pool, self._version)
        return Keyframe(id, name, image, T_world_camera, footprint, visible)

    def _take_out(self, keyframe: Keyframe) -> None:
        """Undo :meth:`_place`, and withdraw the keyframe's messages."""
        if keyframe.messages is not None:
            self._refresh(keyframe)
            if len(keyframe.visible.slots):
                sum_product.withdraw(keyframe.visible.slots, self._pool.belief, keyframe.messages)
        footprint = keyframe.footprint
        self._topology.add_crossings(footprint.window.bricks_of(footprint.crossed), -1)
        self._disown(footprint)

    def _disown(self, footprint: Footprint) -> None:
        surface = footprint.window.bricks_of(footprint.surface)
        slots = self._topology.slots(surface)
        self._pool.owners[slots] -= 1
        orphans = self._pool.owners[slots] == 0
        if orphans.any():
            self._topology.erase(surface[orphans])
            self._pool.release(slots[orphans])
            self._version += 1

    def _refresh(self, keyframe: Keyframe) -> None:
        """Bring a keyframe's list of bricks up to date; bricks that it did not know get no message yet."""
        current = keyframe.visible
        if current.version != self._version:
            current = find_visible(keyframe.footprint, self._topology, self._pool, self._version)
        if keyframe.messages is None or current is not keyframe.visible:
            precision = self.config.inference.message_precision
            keyframe.messages = new_messages(current, precision, keyframe.visible, keyframe.messages)
            keyframe.visible = current

    def _restore_messages(self) -> None:
        """A loaded map has no messages, because they are large and follow from the images."""
        if self._messages_lost:
            self.infer()


def prior_probability(inference: InferenceConfig, voxel_size: float) -> float:
    """The prior of a voxel: as given, or 1 - exp(-density * voxel size), which is the chance of meeting
    a surface on the way through a voxel."""
    if inference.prior is not None:
        return inference.prior
    prior = -math.expm1(-inference.surface_density * voxel_size)
    if not 0 < prior < 1:
        raise ConfigError(
            f"inference.surface_density {inference.surface_density} and voxel_size {voxel_size} give a prior "
            f"of {prior}"
        )
    return prior
