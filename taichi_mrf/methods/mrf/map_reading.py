"""A map to be queried and exported, but not changed: other beliefs over the bricks of an MRFMap."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np

from taichi_mrf.config.method import Method
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.methods.brick_map import BrickMap
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.methods.mrf.pixel_layer import PixelLayer
from taichi_mrf.methods.mrf.surfacing import (
    map_surface,
    measured_depth_of,
    rendered,
    surface,
    surface_field,
    surface_field_of,
)
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.measured_depth import MeasuredDepth
from taichi_mrf.queries.view import View
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.topology import Topology


@dataclass(frozen=True)
class RaysThen:
    """The rays that make a reading's surface and colours: those of the keyframes up to ``stamp_s`` (all if
    None), judged by the log-odds ``belief`` (capacity * 512). Where the reading has no voxel of the
    probability ``least``, there is no surface; frozen keyframes count if ``with_frozen``."""

    belief: "ti.Ndarray"
    stamp_s: float | None
    least: float
    with_frozen: bool


class MapReading(BrickMap):
    """Other beliefs over the bricks of a map: a read-only map for queries and exports.

    It is valid until a keyframe of the map is added, removed, moved or frozen.
    """

    def __init__(
        self, source: OccupancyMap, parts: MapParts, belief: "ti.Ndarray", rays: RaysThen | None = None
    ) -> None:
        """``belief`` (capacity * 512) are log-odds of the voxels of the source's pool, ``parts`` are the
        source's; without ``rays``, surface and colours are those of the source."""
        self.METHOD: Method = source.METHOD  # type: ignore[misc]
        self.config, self.sensor, self.noise = source.config, source.sensor, source.noise
        self.voxel_size = source.voxel_size
        self._source, self._parts, self._rays = source, parts, rays
        self._registry, self._version, self._up = parts.registry, parts.registry.version, source.up
        self.seen_free_log_odds = source.seen_free_log_odds
        self.promise = source.promise
        self._pool = parts.pool.with_beliefs(belief)
        shown = source.view
        self.view = View(
            self._pool, self.voxel_size, shown.volume, shown.occlusion, shown.predicting, shown.index
        )

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes of the map that is read."""
        return MappingProxyType(self._parts.keyframes)

    @property
    def pixel_layers(self) -> Mapping[str, PixelLayer]:
        """The layers that pixels feed, by the time that is read."""
        self._check()
        return self._layers

    @property
    def has_surface(self) -> bool:
        """True if there is a surface of all keyframes that the reading was made of."""
        if self._rays is None:
            return self._parts.has_surface
        frozen = self._rays.with_frozen and bool(self._parts.frozen)
        return bool(self._seen or frozen) and (self._parts.kept.wanted or not frozen)

    def surface_field(self) -> DistanceField:
        """The signed distances that the keyframes of the reading measured. Raises CapacityError."""
        self._check()
        if self._rays is None:
            return surface_field(self._parts)
        return surface_field_of(self._parts, self._judging, self._seen, self._rays.with_frozen)

    def _measured_surface(self) -> MeasuredDepth | None:
        """That of the source, or of the keyframes of the reading."""
        self._check()
        if self._rays is None:
            return rendered(self._source, self._parts)
        return self._own_surface if self.has_surface else None

    @cached_property
    def _own_surface(self) -> MeasuredDepth:
        assert self._rays is not None
        return measured_depth_of(self, self.surface_field(), self._rays.least)

    def surface(self) -> FusedSurface:
        """The surface as of the time that is read, or that of the layer, as MRFMap.surface. Raises
        ConfigError if no keyframe was there yet."""
        if self._rays is None:
            self._check()
            return map_surface(self._source, self._parts)
        if not self.has_surface:
            raise ConfigError("there is no surface at this time: all keyframes are later")
        return surface(self, self.surface_field(), self._rays.least)

    @cached_property
    def _seen(self) -> dict[int, Keyframe]:
        """The keyframes whose rays count."""
        assert self._rays is not None
        until_s = np.inf if self._rays.stamp_s is None else self._rays.stamp_s
        return {id: k for id, k in self._parts.keyframes.items() if k.stamp_s <= until_s}

    @cached_property
    def _judging(self) -> BrickPool:
        """The bricks with the log-odds that rays are judged by."""
        assert self._rays is not None
        return self._parts.pool.showing_others(self._rays.belief)

    @cached_property
    def _layers(self) -> dict[str, PixelLayer]:
        layers, rays = self._parts.layers, self._rays
        if rays is None:
            return layers
        return {n: each.of_some(self._seen, self._judging, rays.with_frozen) for n, each in layers.items()}

    def _check(self) -> None:
        if self._registry.version != self._version:
            raise KeyframeError(
                "the map has changed since it was read: call at(), layer() or reading() again"
            )

    def _grid(self) -> tuple[float, Topology, BrickPool, float]:
        self._check()
        return super()._grid()
