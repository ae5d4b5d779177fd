"""The parts that an MRFMap is composed of.

The functions that infer, move keyframes, read, store and make surfaces take them as an argument; MRFMap names
these functions and has no state beside them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Generic, TypeVar

from numpy.typing import ArrayLike

from taichi_mrf.alignment.keyframe_surfels import KeyframeSurfels
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import KeyframeError
from taichi_mrf.inference.incremental import IncrementalInference
from taichi_mrf.inference.keyframe import DepthImage, Keyframe, checked_depth, checked_images
from taichi_mrf.inference.keyframe_bounds import KeyframeBounds
from taichi_mrf.inference.ray_list import RayBundler
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.methods.mrf.decided import Decisions
from taichi_mrf.methods.mrf.kept_rays import KeptRays
from taichi_mrf.methods.mrf.keyframe_allocator import KeyframeAllocator
from taichi_mrf.methods.mrf.memory_budget import MemoryBudget
from taichi_mrf.methods.mrf.pixel_layer import PixelLayer
from taichi_mrf.methods.protocol import MapStatistics, measure
from taichi_mrf.queries.view import View
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import NoiseModel, warn_of_bad_sigma
from taichi_mrf.sensor.own_evidence import checked_evidence, checked_no_return
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.later import later
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.layers import pixel_layers
from taichi_mrf.voxels.pool import BrickPool

if TYPE_CHECKING:
    from taichi_mrf.inference import dated
    from taichi_mrf.queries.measured_depth import MeasuredDepth
else:
    (dated,) = later("taichi_mrf.inference", "dated")

FoundT = TypeVar("FoundT")


class Once(Generic[FoundT]):
    """A value that is found once for each state of a map."""

    def __init__(self) -> None:
        self._found: tuple[MadeOf, FoundT] | None = None

    @property
    def value(self) -> FoundT | None:
        """The value that was found last, None before."""
        return None if self._found is None else self._found[1]

    def of(self, parts: "MapParts", find: Callable[[], FoundT]) -> FoundT:
        """The value of the present state, found now if it is another."""
        made_of = MadeOf(parts)
        if self._found is None or self._found[0] != made_of:
            self._found = None  # its memory, before there is another
            self._found = made_of, find()
        return self._found[1]


@dataclass
class MapParts:
    """``prior`` is a voxel's probability, ``layers`` are those that pixels feed, by name, ``keyframes`` those
    that can still be moved and removed, ``frozen`` the names of the others, by id."""

    config: Config
    prior: float
    view: View
    registry: BrickRegistry
    dated: "dated.DatedBelief | None"
    allocator: KeyframeAllocator
    sweeper: Sweeper
    incremental: IncrementalInference
    surfels: KeyframeSurfels
    layers: dict[str, PixelLayer]
    kept: KeptRays
    decisions: Decisions
    keyframes: dict[int, Keyframe]
    frozen: dict[int, str] = field(default_factory=dict)
    messages_lost: bool = False
    """A loaded map has beliefs, but no messages."""
    settled: bool = True
    """The marginals are those of a full inference with the configured sweeps."""

    measured: Once[DistanceField] = field(default_factory=Once)
    rendered: "Once[MeasuredDepth]" = field(default_factory=Once)
    decided: "Once[ti.Ndarray]" = field(default_factory=Once)
    calibrated: "Once[ti.Ndarray]" = field(default_factory=Once)

    @staticmethod
    def of(
        config: Config, prior: float, view: View, registry: BrickRegistry, limits: Limits,
        restore_messages: Callable[["MapParts"], object],
    ) -> "MapParts":  # fmt: skip
        """The parts of an empty map."""
        inference, volume, pool = config.inference, config.volume, registry.pool
        keyframes: dict[int, Keyframe] = {}
        beliefs = None
        if not config.time.is_static:  # evidence has a date
            beliefs = pool.dated = dated.DatedBelief(pool, config.time, lambda: keyframes.values())
        bundler, bounds = RayBundler(config.voxel_size, inference), KeyframeBounds()
        placing = (config.sensor, volume, limits.precision, bounds, MemoryBudget(pool, limits.precision))
        allocator = KeyframeAllocator(registry, bundler, *placing, beliefs)
        sweeper = Sweeper(config.voxel_size, config.sensor, inference, volume, limits)
        note_sweep = None if beliefs is None else beliefs.note_sweep
        renewing = (bounds, allocator.look_again, allocator.refresh, inference.renew_tolerance, note_sweep)
        kept = KeptRays(config.keep_surface)
        fed = (registry, keyframes, sweeper, allocator.refresh, lambda: restore_messages(parts))
        layers = {name: PixelLayer(name, *fed) for name in pixel_layers()}
        registry.on_release = [layer.forget for layer in layers.values()]
        parts: MapParts = MapParts(
            config=config,
            prior=prior,
            view=view,
            registry=registry,
            dated=beliefs,
            allocator=allocator,
            sweeper=sweeper,
            incremental=IncrementalInference(pool, sweeper, *renewing),
            surfels=KeyframeSurfels(config.voxel_size, config.sensor.max_depth),
            layers=layers,
            kept=kept,
            decisions=Decisions(registry, keyframes, kept, sweeper),
            keyframes=keyframes,
        )
        return parts

    @property
    def pool(self) -> BrickPool:
        """The voxels."""
        return self.registry.pool

    @property
    def has_surface(self) -> bool:
        """True if the surface of all keyframes can be made: none is frozen, or their measurements are kept
        (``keep_surface``)."""
        return bool(self.keyframes or self.frozen) and (self.kept.wanted or not self.frozen)

    @property
    def now_s(self) -> float:
        """The time that the map is for, in seconds: the newest keyframe's stamp; NaN without keyframes."""
        if self.dated is not None:
            now = self.dated.now_s
        else:
            now = max((keyframe.stamp_s for keyframe in self.keyframes.values()), default=-math.inf)
        return now if math.isfinite(now) else math.nan

    @property
    def found_bytes(self) -> int:
        """Bytes of layers, of what frozen keyframes measured, of states and surfaces once asked for."""
        log_odds = (self.decided.value, self.calibrated.value)
        asked = sum(4 * int(each.shape[0]) for each in log_odds if each is not None)
        surfaces = (self.measured.value, self.rendered.value)
        asked += sum(each.nbytes for each in surfaces if each is not None)
        asked += sum(layer.nbytes for layer in self.layers.values())
        return self.kept.share.nbytes + self.decisions.nbytes + asked

    def image(
        self, model: NoiseModel, depth_m: ArrayLike, camera: Camera, color: ArrayLike | None,
        noise: NoiseModel | None, sigma_m: ArrayLike | None, no_return: ArrayLike | None,
        pose_covariance: ArrayLike | None, images: Mapping[str, ArrayLike] | None = None,
    ) -> DepthImage:  # fmt: skip
        """The arguments of BrickMap.add_keyframe, checked, on the device; ``model`` is the map's noise."""
        sensor = self.config.sensor
        depth = checked_depth(depth_m, camera, sensor.min_depth)
        depth, own = checked_evidence(depth, camera, noise, sigma_m, pose_covariance)
        counts = sensor.no_return != "ignore"
        beside = checked_images({"color": color, **(images or {})}, camera)
        missing = checked_no_return(no_return, depth_m, camera, counts)
        color, own = beside.pop("color", None), replace(own, no_return=missing, images=beside)
        image = DepthImage.upload(depth, camera, model, color, own)
        if not self.keyframes:
            warn_of_bad_sigma(image.noise_table, sensor.min_depth, sensor.max_depth)
        return image

    def statistics(self) -> MapStatistics:
        """The size of the map."""
        keyframes, waiting = self.keyframes.values(), 0 if self.dated is None else self.dated.waiting_bytes
        images = sum(k.image_bytes for k in keyframes)
        return measure(
            self.pool,
            keyframes=len(keyframes),
            frozen=len(self.frozen),
            rays=sum(k.rays for k in keyframes),
            message_bytes=sum(k.voxel_bytes for k in keyframes) + waiting,
            other_bytes=images + self.sweeper.nbytes + self.found_bytes,
        )

    def find(self, id: int) -> Keyframe:
        """A keyframe that can be moved and removed. Raises KeyframeError."""
        if id in self.frozen:
            raise KeyframeError(f"keyframe {id} ({self.frozen[id]}) is frozen")
        if id not in self.keyframes:
            raise KeyframeError(f"there is no keyframe {id}")
        return self.keyframes[id]


class MadeOf:
    """The state of a map that its surface and its states follow from: its beliefs, whether these are settled,
    its bricks, and its keyframes, which are kept, because their identity is compared."""

    def __init__(self, parts: MapParts) -> None:
        pool = parts.pool
        self._numbers = pool.revision, parts.settled, parts.registry.version
        self._parts = pool.shown, *parts.keyframes.values()

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, MadeOf)
            and self._numbers == other._numbers
            and len(self._parts) == len(other._parts)
            and all(a is b for a, b in zip(self._parts, other._parts, strict=True))
        )
