"""The surface of an MRFMap below the size of its voxels, from its keyframes and marginals."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.export.fused_surface import FusedSurface, fused_surface, without_free
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.surface_field import SurfaceRays
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.methods.brick_map import BrickMap
from taichi_mrf.methods.mrf.coloring import MapColors
from taichi_mrf.methods.mrf.kept_rays import KeptRays
from taichi_mrf.queries.colored import blended_colors, is_colored
from taichi_mrf.queries.known_bricks import BrickReader, QueriedMap, sorted_bricks
from taichi_mrf.queries.measured_depth import MeasuredDepth
from taichi_mrf.queries.points import probability
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.pool import BrickPool

OUTLIERS = 0.01
"""Share of the measurements that may come from anywhere in the sensor's range."""


LEAST = 0.5
"""Least marginal of a surface, as a share of the prior: where none reaches it, there is no surface."""

FREE = 0.05
"""A ray passes a surface in the midst of voxels below this share of the prior. It is lower than LEAST, since
poses that are off leave surfaces in voxels that other keyframes saw through."""


class MadeOf:
    """The state of a map that its surface and its states follow from: its beliefs, whether these are settled,
    its bricks, and its keyframes, which are kept, because their identity is compared."""

    def __init__(self, m: "WithSurface") -> None:
        pool = m._pool
        self._numbers = pool.revision, m._settled, m._registry.version
        self._parts = pool.shown, *m.keyframes.values()

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, MadeOf)
            and self._numbers == other._numbers
            and len(self._parts) == len(other._parts)
            and all(a is b for a, b in zip(self._parts, other._parts, strict=True))
        )


class WithSurface(BrickMap):
    """The part of an MRFMap that makes its surface."""

    prior: float
    _keyframes: dict[int, Keyframe]
    _frozen: dict[int, str]
    _sweeper: Sweeper
    _kept: KeptRays
    _colors: MapColors
    _settled: bool
    _measured: tuple[MadeOf, DistanceField] | None = None
    _rendered: tuple[MadeOf, MeasuredDepth] | None = None

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes that can still be moved and removed, by id."""
        raise NotImplementedError

    @property
    def frozen(self) -> Mapping[int, str]:
        """Names of the keyframes that have been frozen, by id."""
        return MappingProxyType(self._frozen)

    @property
    def keeps_surface(self) -> bool:
        """True if frozen keyframes leave what they measured of the surface."""
        return self._kept.wanted

    @property
    def has_surface(self) -> bool:
        """True if there is a surface of all keyframes that the map was made of: none is frozen, or what
        frozen ones measured is kept (``keep_surface``)."""
        return bool(self._keyframes or self._frozen) and (self.keeps_surface or not self._frozen)

    def measured_bricks(self) -> NDArray[np.int32]:
        """The bricks (n, 3) in which keyframes that are not frozen have a say in the surface; ascending."""
        rays = SurfaceRays(self._pool, self._sweeper.model(), self.config.volume)
        bands = map(rays.bricks_in_band, self._keyframes.values())
        found = [window.bricks_of(cells) for window, cells in bands]
        return sorted_bricks(np.concatenate([np.zeros((0, 3), np.int32), *found]))

    def surface_field(self, between: Callable[[], object] = lambda: None) -> DistanceField:
        """The signed distances that the keyframes measured, as of the last :meth:`infer`: found once for each
        state of the map, and not to be written to. ``between`` is called after each keyframe. Raises
        CapacityError if there is not enough memory."""
        made_of = MadeOf(self)
        if self._measured is None or self._measured[0] != made_of:
            self._measured = None  # its memory, before there is another
            self._measured = made_of, surface_field_of(self, self._pool, self._keyframes, between=between)
        return self._measured[1]

    def surface(self, between: Callable[[], object] = lambda: None) -> FusedSurface:
        """The surface that the keyframes measured, by marching cubes through the mean of their signed
        distances: vertices, triangles, normals, and for each vertex a standard deviation in metres, and its
        colour if keyframes have colour images.

        It is made from the keyframes' images and the marginals as they are now, so call :meth:`infer` before.
        Frozen keyframes have no images: their part is kept with ``keep_surface``, else they have none.
        ``between`` is called many times in a second; what it raises ends the work. Raises ConfigError for a
        map without keyframes, CapacityError if there is not enough memory.
        """
        if not self._keyframes and not self.has_surface:
            raise ConfigError("the map has no keyframes: there is nothing to make a surface of")
        found = fused_surface(self.surface_field(between), self.voxel_size, between)
        found = without_free(self, found, LEAST * self.prior)
        colors = blended_colors(self, found.vertices_m) if is_colored(self) else None
        return replace(found, colors=colors)

    def _measured_surface(self) -> MeasuredDepth | None:
        """Found once for each state of the map."""
        if not self.has_surface:
            return None
        made_of = MadeOf(self)
        if self._rendered is None or self._rendered[0] != made_of:
            self._rendered = made_of, measured_depth_of(self, self.surface_field(), FREE * self.prior)
        return self._rendered[1]

    def _prepare_colors(self) -> None:
        raise NotImplementedError

    def _keep_rays(self, keyframe: Keyframe) -> None:
        """Keep what a keyframe's rays say of the surface, if that is wanted; it is about to be frozen."""
        if self._kept.wanted:
            visible = self._registry.visible(keyframe.footprint)
            models = _model_of(self), self._sweeper.model()
            share = self._kept.freeze(keyframe, visible, self._pool, models, self.config.volume)
            if self._registry.before_claim is not None:  # what is outside of the window comes back
                self._registry.before_claim(share.distances.bricks)
            self._kept.restore(share)


def measured_depth_of(m: QueriedMap, field: DistanceField, least: float) -> MeasuredDepth:
    """The surface of a field as rays meet it. A map, or a reading of it, takes voxels for free whose
    probability is below ``least``."""
    free = probability(BrickReader(m).log_odds(field.bricks)) < least
    return MeasuredDepth(field, free, m.voxel_size)


def surface_field_of(
    m: WithSurface,
    pool: BrickPool,
    keyframes: Mapping[int, Keyframe],
    with_frozen: bool = True,
    between: Callable[[], object] = lambda: None,
) -> DistanceField:
    """The signed distances that some of a map's keyframes measured, with the marginals of ``pool``, and
    perhaps those of frozen ones. Raises CapacityError."""
    rays = SurfaceRays(pool, _model_of(m), m.config.volume)
    found = rays.field([(k, m._registry.visible(k.footprint)) for k in keyframes.values()], between)
    return m._kept.added_to(found) if with_frozen else found


def _model_of(m: WithSurface) -> RayModel:
    return replace(m._sweeper.model(), floor=OUTLIERS / m.sensor.max_depth)
