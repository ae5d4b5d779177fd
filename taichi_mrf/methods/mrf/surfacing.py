"""The surface of an MRFMap below the size of its voxels, from its keyframes and marginals."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.export.fused_surface import FusedSurface, fused_surface, without_free
from taichi_mrf.inference.brick_sums import VOTES, BrickSums
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.surface_field import SurfaceRays
from taichi_mrf.inference.surface_votes import count_votes, no_votes
from taichi_mrf.methods.mrf.kept_rays import STEPS, RayShare
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.queries.colored import blended_colors
from taichi_mrf.queries.known_bricks import BrickReader, sorted_bricks
from taichi_mrf.queries.measured_depth import MeasuredDepth
from taichi_mrf.queries.points import probability
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.voxels.distance_field import DistanceField
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool

OUTLIERS = 0.01
"""Share of the measurements that may come from anywhere in the sensor's range."""

LEAST = 0.5
"""Least marginal of a surface, as a share of the prior: where none reaches it, there is no surface."""

FREE = 0.05
"""A ray passes a surface in the midst of voxels below this share of the prior. It is lower than LEAST, since
poses that are off leave surfaces in voxels that other keyframes saw through."""


def measured_bricks(parts: MapParts) -> NDArray[np.int32]:
    """The bricks (n, 3) in which keyframes that are not frozen have a say in the surface; ascending."""
    rays = SurfaceRays(parts.pool, parts.sweeper.model(), parts.config.volume)
    bands = map(rays.bricks_in_band, parts.keyframes.values())
    found = [window.bricks_of(cells) for window, cells in bands]
    return sorted_bricks(np.concatenate([np.zeros((0, 3), np.int32), *found]))


def surface_field(parts: MapParts, between: Callable[[], object] = lambda: None) -> DistanceField:
    """MRFMap.surface_field."""
    return parts.measured.of(
        parts, lambda: surface_field_of(parts, parts.pool, parts.keyframes, between=between)
    )


def surface_field_of(
    parts: MapParts,
    pool: BrickPool,
    keyframes: Mapping[int, Keyframe],
    with_frozen: bool = True,
    between: Callable[[], object] = lambda: None,
) -> DistanceField:
    """The signed distances that some of a map's keyframes measured, with the marginals of ``pool``, and
    perhaps those of frozen ones. Raises CapacityError."""
    rays = SurfaceRays(pool, _model_of(parts), parts.config.volume)
    found = rays.field([(k, parts.registry.visible(k.footprint)) for k in keyframes.values()], between)
    return parts.kept.added_to(found) if with_frozen else found


def surface(
    m: VoxelMap, field: DistanceField, least: float, between: Callable[[], object] = lambda: None
) -> FusedSurface:
    """The surface of a field, coloured if the map is, but for where no voxel of the map has the marginal
    ``least``."""
    found = fused_surface(field, m.voxel_size, between)
    found = without_free(found, m.voxel_size, m.marginals.occupancy, least)
    return replace(found, colors=blended_colors(m, found.vertices_m) if m.has_colors else None)


def map_surface(m: VoxelMap, parts: MapParts, between: Callable[[], object] = lambda: None) -> FusedSurface:
    """MRFMap.surface."""
    if not parts.keyframes and not parts.has_surface:
        raise ConfigError("the map has no keyframes, so it has no surface")
    return surface(m, surface_field(parts, between), LEAST * parts.prior, between)


def rendered(m: VoxelMap, parts: MapParts) -> MeasuredDepth | None:
    """The surface of a map as rays meet it; None if it has none."""
    if not parts.has_surface:
        return None
    return parts.rendered.of(parts, lambda: measured_depth_of(m, surface_field(parts), FREE * parts.prior))


def measured_depth_of(m: VoxelMap, field: DistanceField, least: float) -> MeasuredDepth:
    """The surface of a field as rays meet it. A map, or a reading of it, takes voxels for free whose
    probability is below ``least``."""
    free = probability(BrickReader(m).log_odds(field.bricks)) < least
    return MeasuredDepth(field, free, m.voxel_size)


def keep_rays(parts: MapParts, keyframe: Keyframe) -> None:
    """Keep what a keyframe's rays say of the surface, if that is wanted; it is about to be frozen."""
    if not parts.kept.wanted:
        return
    visible, volume = parts.registry.visible(keyframe.footprint), parts.config.volume
    # Only the keyframe's own bricks are looked at, however large the map is.
    part = parts.pool.part(visible.slots)
    seen = [(keyframe, replace(visible, slots=part.in_use, arrays=None))]
    field = SurfaceRays(part, _model_of(parts), volume).field(seen)
    sums = np.rint(field.sums * STEPS).astype(np.int32)
    votes = no_votes(part.belief.shape[0])
    count_votes(seen, part, parts.sweeper.model(), volume, votes)
    bricks, said = parts.pool.bricks[visible.slots], votes.to_numpy().reshape(-1, VOXELS, VOTES)
    share = RayShare(BrickSums.of(field.bricks, sums), BrickSums.of(bricks, said[: len(bricks)]))
    if parts.registry.before_claim is not None:  # what is outside of the window comes back
        parts.registry.before_claim(share.distances.bricks)
    parts.kept.restore(share)


def _model_of(parts: MapParts) -> RayModel:
    return replace(parts.sweeper.model(), floor=OUTLIERS / parts.config.sensor.max_depth)
