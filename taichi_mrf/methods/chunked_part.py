"""A box of a chunked map, loaded into memory for queries and exports; or the whole map, to continue it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.registry import METHODS, methods_with
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.fused_surface import FusedSurface, fused_surface, within_voxels, without_free
from taichi_mrf.geometry.poses import as_pose
from taichi_mrf.geometry.up import Up
from taichi_mrf.methods.capabilities import window_of
from taichi_mrf.methods.chunked import SAME_LOG_ODDS, ChunkedMap, StoredLayer
from taichi_mrf.methods.map_file import MapHeader
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.storage import MapContents
from taichi_mrf.methods.mrf.surfacing import LEAST
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.stored_distances import StoredDistances
from taichi_mrf.queries.box import voxels_of_box
from taichi_mrf.queries.colored import blended_colors
from taichi_mrf.queries.known_bricks import BrickReader
from taichi_mrf.queries.points import checked_points
from taichi_mrf.queries.view import Answer, View
from taichi_mrf.queries.voxel_map import PixelReader, PixelValues, Placed
from taichi_mrf.queries.within import occupied_within, path_collision
from taichi_mrf.sensor.camera import Camera, check_camera
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise
from taichi_mrf.sensor.origins import widened
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.owner import owned_attribute
from taichi_mrf.voxels.layout import BRICK, CHUNK, grid_keys, split_bricks
from taichi_mrf.voxels.pool import BrickPool

_MARGIN = BRICK
"""Voxels around a part from which its surface is made too, before it is cut: more than any vertex's position,
normal and standard deviation depend on."""


@dataclass
class MapPart(PixelReader):
    """The bricks of a chunked map from ``lowest`` to ``after`` (exclusive), (3,) each; everything outside is
    unknown. ``free_bricks`` (n, 3) were seen to be free and have no voxels. It has the queries of a map, but
    no keyframes and no inference."""

    source: ChunkedMap
    lowest: NDArray[np.int64]
    after: NDArray[np.int64]
    view: View = owned_attribute()  # noqa: RUF009, a descriptor and no default
    free_bricks: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    keyframes: Mapping[int, Placed] = field(default_factory=dict)
    voxel_size: float = field(init=False)

    def __post_init__(self) -> None:
        self.voxel_size = self.source.voxel_size

    @property
    def config(self) -> Config:
        """The parameters that the map was made with."""
        return self.source.config

    @property
    def seen_free_log_odds(self) -> float:
        """Log-odds of space that was seen to be free without a surface near."""
        return self.source.header.seen_free_log_odds

    @property
    def sensor(self) -> SensorConfig:
        """The parameters of the sensor."""
        return self.source.config.sensor

    @property
    def noise(self) -> NoiseModel:
        """The noise that these parameters describe."""
        return PolynomialNoise(self.sensor.sigma, self.sensor.bias)

    @property
    def up(self) -> Up | None:
        """The world axis that is up, None if the store does not hold it."""
        return self.source.up

    @tensors.in_kind("T_world_camera")
    def render_depth(
        self, camera: Camera, T_world_camera: ArrayLike, by: Answer = "omega"
    ) -> NDArray[np.float32]:
        """Axial depth (H, W) of the centre of each pixel's most likely voxel; NaN for none."""
        check_camera(camera)
        return self.view.render_depth(camera, as_pose(T_world_camera), self.sensor.max_depth)

    def measured_depth(
        self, likeliest_m: NDArray[np.float32], camera: Camera, T_world_camera: ArrayLike
    ) -> NDArray[np.float32]:
        """NaN everywhere (H, W): a part does not use the measured surface."""
        return np.full(camera.shape, np.nan, np.float32)

    @tensors.in_kind("points")
    def occupancy(self, points: ArrayLike) -> NDArray[np.float32]:
        """Probability of occupied at (N, 3) points in metres, (N,)."""
        points_m = checked_points(points)
        return np.where(
            self._inside(points_m), self.source.occupancy(points_m), np.float32(self.source.prior)
        )

    @cached_property
    def decided(self) -> "MapPart":
        """The part with decided states, as MRFMap.decided."""
        by_votes, brick_m = self.source.decided, BRICK * self.voxel_size
        if by_votes is self.source:
            return self
        return take_part(by_votes, self.lowest * brick_m, self.after * brick_m)

    @cached_property
    def marginals(self) -> "MapPart":
        """The part by its marginals alone, as MRFMap.marginals."""
        alone, brick_m = self.source.marginals, BRICK * self.voxel_size
        if alone is self.source:
            return self
        return take_part(alone, self.lowest * brick_m, self.after * brick_m)

    @cached_property
    def _likely(self) -> "MapPart":
        """The part that decides the states of voxels if the map holds the rays' measurements, else itself."""
        return self.decided if self.source.holds_marginals and self.has_surface else self

    @tensors.in_kind("points")
    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        """UNKNOWN, FREE or OCCUPIED at (N, 3) points in metres, (N,)."""
        points_m = checked_points(points)
        return np.where(self._inside(points_m), self.source.state(points_m), np.int8(0))

    def voxels(self, min_probability: float = 0.5) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """All observed voxels of at least this probability: centres (N, 3) in metres, and (N,)."""
        brick_m = BRICK * self.voxel_size
        return self.source.voxels(self.lowest * brick_m, self.after * brick_m, min_probability)

    @property
    def pixel_layers(self) -> Mapping[str, PixelValues]:
        """The layers that pixels feed, as of ChunkedMap, outside of the box too: the colours of a mesh at its
        border are blended with those beyond."""
        bricks, names = self.view.pool.bricks, self.source.pixel_layers
        return {name: StoredLayer(self.source, name, bricks) for name in names}

    @property
    def has_surface(self) -> bool:
        """True if the map holds the measured surface."""
        return self.source.has_surface

    def surface(self) -> FusedSurface:
        """The surface that the keyframes measured, as MRFMap.surface: that of the cells whose first voxel is
        in the box, so that the surfaces of adjoining parts meet. Raises ConfigError if the map holds none."""
        if not self.has_surface:
            raise ConfigError(
                f"{self.source.store.path}: holds no measured surface: map the recording again with "
                "--keep-surface, or export from the map.npz of a run"
            )
        first, after = self.lowest * BRICK, self.after * BRICK
        distances = self.source.distances(first - _MARGIN, after + _MARGIN)
        found = fused_surface(distances, self.voxel_size)
        found = without_free(
            found, self.voxel_size, self.source.marginals.occupancy, LEAST * self.source.prior
        )
        found = within_voxels(found, self.voxel_size, first, after)
        return replace(found, colors=blended_colors(self, found.vertices_m) if self.has_colors else None)

    @tensors.in_kind("points")
    def occupied_within(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that something lies within ``radius_m`` of points (N, 3) in metres, (N,), as
        OccupancyMap.occupied_within."""
        return occupied_within(points, radius_m, *self._likely._grid())

    @tensors.in_kind("points")
    def path_collision(self, points: ArrayLike, radius_m: float) -> NDArray[np.float32]:
        """The probability that a ball hits something on its way along paths (..., N, 3), as
        OccupancyMap.path_collision."""
        return path_collision(points, radius_m, *self._likely._grid())

    def _grid(self) -> tuple[float, "_PartIndex", BrickPool, float]:
        index = _PartIndex(BrickReader(self), self.free_bricks)
        return self.voxel_size, index, self.view.pool, self.seen_free_log_odds

    def surface_field(self) -> StoredDistances:
        """The signed distances in the box."""
        return self.source.distances(self.lowest * BRICK, self.after * BRICK)

    def _inside(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        bricks = np.floor(points_m / (self.voxel_size * BRICK))
        return np.all((bricks >= self.lowest) & (bricks < self.after), axis=1)


class _PartIndex:
    """Index of a part's bricks in its pool, and which have been crossed, for queries."""

    def __init__(self, reader: BrickReader, free_bricks: NDArray[np.int32]) -> None:
        self.slots, self._free = reader.slots, np.sort(grid_keys(free_bricks))

    def crossings(self, bricks: NDArray[np.int32]) -> NDArray[np.int32]:
        """1 for bricks (n, 3) that were seen to be free, (n,)."""
        return np.isin(grid_keys(bricks), self._free).astype(np.int32)


def render_chunked(m: ChunkedMap, camera: Camera, T_world_camera: ArrayLike) -> NDArray[np.float32]:
    """Axial depth (H, W) of the surface that each pixel sees, as OccupancyMap.render_depth, of a map that may
    be larger than memory; the part that is in view may not."""
    check_camera(camera)
    T, max_depth = as_pose(T_world_camera), m.config.sensor.max_depth
    ends = camera.rays().reshape(-1, 3).astype(np.float64) * max_depth @ T[:3, :3].T + T[:3, 3]
    corners = np.concatenate([ends, T[None, :3, 3]])
    try:
        part = take_part(m, *widened(camera, T, corners.min(axis=0), corners.max(axis=0)))
    except ConfigError:  # there is no surface in view
        return np.full(camera.shape, np.nan, np.float32)
    return part.render_depth(camera, T)


def in_chunks(m: OccupancyMap) -> ChunkedMap | None:
    """The chunked map that holds the parts of a map outside its window, as they were when they left memory,
    and the others as of the last save. None for a map that is in memory as a whole."""
    window = window_of(m)
    if window is None or window.folder is None or not len(window.parked):
        return None
    return ChunkedMap.open(window.folder)


def take_part(m: ChunkedMap, lower: ArrayLike | None = None, upper: ArrayLike | None = None) -> MapPart:
    """Load the bricks that overlap a box, given by two corners, (3,) in metres each; None stands for the
    map's corner. Raises ConfigError for corners that make no box or for an empty map, CapacityError if there
    is not enough memory."""
    runtime.init()
    low, high = m.extent
    corners = low if lower is None else lower, high if upper is None else upper
    first, after = voxels_of_box(*corners, m.voxel_size)
    lowest, after = first // BRICK, -(-after // BRICK)
    pool = BrickPool(m.header.prior_log_odds, m.config.volume.memory_limit_gb)
    free = [np.zeros((0, 3), np.int32)]
    for chunk, block in m.blocks(*corners):
        values = split_bricks(block)
        bricks = np.indices((CHUNK,) * 3).reshape(3, -1).T + np.array(chunk) * CHUNK
        inside = ((bricks >= lowest) & (bricks < after)).all(axis=1)
        # Free and unknown space away from surfaces needs no voxels: occupancy() and state() read the chunks.
        known = ~np.isnan(values)
        near = (np.abs(values - m.header.seen_free_log_odds) >= SAME_LOG_ODDS).any(axis=1)
        free.append(bricks[inside & ~near & known.any(axis=1)].astype(np.int32))
        taken = np.flatnonzero(inside & near)
        if len(taken):
            slots = pool.allocate(bricks[taken].astype(np.int32))
            pool.owners[slots] = 1
            pool.write("total", slots, np.where(known, values, m.header.prior_log_odds)[taken])
    if not len(pool.in_use):
        raise ConfigError("there is no surface in this box of the map")
    volume = replace(m.config.volume, min_evidence=m.header.min_evidence)
    return MapPart(m, lowest, after, View(pool, m.voxel_size, volume), np.concatenate(free))


def config_in_memory(m: ChunkedMap) -> Config:
    """The parameters of :func:`in_memory`. Raises MapFileError as it does."""
    config, path = m.config, m.store.path
    if not METHODS[config.method].can_freeze:
        raise MapFileError(f"{path}: only maps of the method {methods_with('can_freeze')} can be continued")
    if config.time.half_life_s > 0:
        raise MapFileError(f"{path}: its world may change, and chunks hold no dates: pass a map.npz")
    return replace(config, keep_surface=False, volume=replace(config.volume, window_m=0.0))


def in_memory(m: ChunkedMap, memory_limit_gb: float | None = None) -> MRFMap:
    """All of a map in chunks, by its marginals, as if all its keyframes had been frozen: without colours and
    the measured surface. Raises MapFileError for a map whose evidence is not that of keyframes or has dates,
    and as :func:`take_part`."""
    config, part = config_in_memory(m), take_part(m.marginals)
    pool = part.view.pool
    bricks, belief = pool.bricks[pool.in_use], pool.read("belief", pool.in_use)
    contents = MapContents(
        header=MapHeader(config, part.noise, [], next_id=1, up=m.up),
        bricks=bricks,
        belief=belief,
        evidence=belief,
        total=None,
        frozen_dated=None,
        waiting=[],
        frozen_owners=np.ones(len(bricks), np.int32),
        frozen_crossed=np.concatenate([bricks, part.free_bricks]),
        frozen={0: m.store.path.name},
        parked=[],
        layers={},
        shares={},
        kept=RayShare.nothing(),
    )
    return MRFMap.holding(contents, m.store.path, memory_limit_gb)
