"""The factor graph of depth keyframes as it is, without MRFMap's average messages: one factor for each ray.

A voxel's marginal in MRFMap rests on one approximation beyond loopy belief propagation: all rays of a
keyframe send a voxel the same, average message (section IV-A of Shankar & Michael, RSS 2020). Here every ray
keeps its own. The rays, the voxels that they cross and the likelihoods nu (eq. 4) are those of
inference/sum_product.py; a ray's energy is

    -log(nu_k + floor)       if its k-th voxel is the first occupied one
    -log(beyond + floor)     if none is, where beyond is for rays that leave the map before they end

so that the outlier floor lies in the likelihood itself, which is where eqs. 13 and 14 with a floor on both
sides put it. A voxel's prior is a factor over that voxel alone, which looks like a ray with one cell. Voxels
are not weighed by length: with lengths there is no joint distribution that the factors belong to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.factor_graph.beams import BrickCells
from taichi_mrf.factor_graph.graph import FactorGraph, check_capacity, count_degrees
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.ray_model import END_SIGMAS
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.sensor.forward import AUTO
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, F32Array2, I32Array, Struct, Template
from taichi_mrf.voxels.log_odds import softplus
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels
from taichi_mrf.voxels.window import WindowIndex


@dataclass(frozen=True)
class _RayFactors(Bundle):
    """Parameters of the factors of all rays (InferenceConfig)."""

    voxel_size: F32
    """Metres."""

    max_depth: F32
    """Metres of depth that no ray goes beyond."""

    end_sigmas: F32
    """A ray ends this many sigmas behind its measurement."""

    floor: F32
    """Density, per metre, of a measurement that no surface explains."""


@ti.dataclass
class _Way(Struct):
    """A ray on its way."""

    steps: I32  # voxels crossed so far


@dataclass(frozen=True)
class _Factor(Bundle):
    """One ray, and where its cells and energies are written."""

    sensor: Sensor
    measured: F32
    noise: Template  # of its pixel
    support: F32  # depth before which no surface can have made the measurement
    model: _RayFactors
    edge: I32
    entry: I32
    cells: I32Array
    table: F32Array2


@ti.func
def _count_voxel(way: Template, nothing: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray whose voxels are counted."""
    way.steps += 1
    return 1


@ti.func
def _write_voxel(way: Template, factor: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray: a cell of its factor, and the energy of the first surface lying there."""
    density = 0.0
    if far > factor.support:
        density = factor.sensor.likelihood(
            factor.measured, near, far, factor.noise, factor.model.voxel_size, AUTO
        )
    factor.cells[factor.edge + way.steps] = voxel
    factor.table[factor.entry + way.steps, 0] = -ti.log(density + factor.model.floor)
    way.steps += 1
    return 1


@kernel
def _follow(
    pixels: I32Array, depth: F32Array, sensor: Sensor, view: Viewpoint, space: Space, model: _RayFactors,
    beam: I32, begins: AnyArray, cells: I32Array, table: F32Array2, write: Template,
) -> None:  # fmt: skip
    """Follow the rays of some ``pixels`` (n), which are factors ``beam`` and onwards.

    ``depth`` is (H * W) metres. Counts the voxels on each ray's way into ``begins[beam + i + 1]`` (beams +
    1), or, with ``write``, writes them to ``cells`` (edges), and the energies to ``table`` (edges + beams,
    1), at the places in ``begins``.
    """
    for i in range(pixels.shape[0]):
        u, v = sensor.pixel(pixels[i])
        measured = depth[pixels[i]]
        ray = pixel_ray(sensor, view, u, v)
        noise = sensor.noise_at(u, v)
        last = sensor.farthest_depth(measured, noise, model.end_sigmas)
        begin, end = 0.0, ti.min(last, model.max_depth)
        clip(ray, begin, end, space.lower, space.upper)
        way = _Way(0)
        if ti.static(write):
            f = beam + i
            edge, entry = begins[f], begins[f] + f
            support = sensor.support(measured, noise)
            factor = _Factor(sensor, measured, noise, support, model, edge, entry, cells, table)
            walk_voxels(ray, begin, end, space, _write_voxel, way, factor)
            beyond = 0.0
            if end < last:
                beyond = sensor.likelihood_beyond(measured, end, noise)
            table[entry + way.steps, 0] = -ti.log(beyond + model.floor)
        else:
            walk_voxels(ray, begin, end, space, _count_voxel, way, 0)
            begins[beam + i + 1] = way.steps


@ti.kernel
def _write_priors(log_odds: F32Array, beam: I32, edge: I32, cells: I32Array, table: F32Array2):
    """A factor for each cell: occupied costs -log p, and free -log (1 - p).

    ``log_odds`` is (cells); the factors are ``beam`` and onwards, their edges ``edge`` and onwards in
    ``cells`` (edges), their energies in ``table`` (edges + beams, 1).
    """
    for cell in range(log_odds.shape[0]):
        cells[edge + cell] = cell
        entry = edge + cell + beam + cell
        table[entry, 0] = softplus(-log_odds[cell])
        table[entry + 1, 0] = softplus(log_odds[cell])


def depth_graph(
    keyframes: Sequence[Keyframe],
    pool: BrickPool,
    voxel_size: float,
    sensor: SensorConfig,
    inference: InferenceConfig,
    volume: VolumeConfig,
    every: int = 1,
    memory_limit_gb: float = 0.0,
) -> FactorGraph:
    """Every ``every``-th pixel, both ways, of some keyframes as factors over the voxels of the pool.

    Keyframes' lists of visible bricks must be up to date. Raises CapacityError, which names the memory that
    the graph would take, before it is taken, and ConfigError if ``every`` is less than 1.
    """
    if every < 1:
        raise ConfigError(f"every must be at least 1, not {every}")
    slots = pool.in_use
    rank = np.full(max(1, pool.capacity), -1, np.int32)
    rank[slots] = np.arange(len(slots))
    grid = BrickCells(voxel_size, pool.bricks[slots])
    chosen = [_pixels(keyframe, every) for keyframe in keyframes]
    rays = sum(map(len, chosen))
    beams = rays + grid.cells
    advice = "take fewer keyframes or pixels (every), or a larger voxel size"
    check_capacity(beams, grid.cells, grid.cells, memory_limit_gb, True, advice)

    # How many voxels each ray crosses; each cell's prior has one.
    rays_of = _RaysOf(pool, rank, voxel_size, sensor, inference, volume)
    lengths = ti.ndarray(ti.i32, beams + 1)
    lengths.fill(1)
    rays_of.follow(keyframes, chosen, lengths, None)
    begins = lengths.to_numpy().astype(np.int64)
    begins[0] = 0
    longest = int(begins[1:].max(initial=1))
    np.cumsum(begins, out=begins)
    edges = int(begins[-1])
    check_capacity(beams, grid.cells, edges, memory_limit_gb, True, advice)

    # Which ones, and with what energies.
    lengths.from_numpy(begins.astype(np.int32))
    cells, table = ti.ndarray(ti.i32, max(1, edges)), ti.ndarray(ti.f32, (max(1, edges + beams), 1))
    rays_of.follow(keyframes, chosen, lengths, (cells, table))
    prior = np.full(grid.cells, pool.prior_log_odds, np.float32)
    if pool.evidence is not None:  # what has been frozen is what inference starts from
        prior = pool.read("evidence", slots).reshape(-1)
    if grid.cells:
        _write_priors(prior, rays, edges - grid.cells, cells, table)
    degrees, hits = ti.ndarray(ti.i32, max(1, grid.cells)), ti.ndarray(ti.i32, max(1, beams))
    hits.fill(1)
    if edges:
        count_degrees(cells, edges, degrees)
    return FactorGraph(grid, beams, edges, longest, lengths, cells, hits, table, degrees, has_table=True)


def _pixels(keyframe: Keyframe, every: int) -> NDArray[np.int32]:
    """Flat numbers of the pixels that become rays."""
    measured = np.zeros(keyframe.camera.shape, bool)
    measured[::every, ::every] = True
    return np.flatnonzero(measured & (keyframe.depth_m > 0)).astype(np.int32)


class _RaysOf:
    """Follows keyframes' rays through the bricks of a pool, numbered by ``rank``."""

    def __init__(
        self,
        pool: BrickPool,
        rank: NDArray[np.int32],
        voxel_size: float,
        sensor: SensorConfig,
        inference: InferenceConfig,
        volume: VolumeConfig,
    ) -> None:
        self.pool, self.rank, self.voxel_size = pool, rank, voxel_size
        self.sensor, self.inference, self.volume = sensor, inference, volume
        self.index = WindowIndex()

    def follow(
        self,
        keyframes: Sequence[Keyframe],
        chosen: Sequence[NDArray[np.int32]],
        begins: "ti.Ndarray",
        into: "tuple[ti.Ndarray, ti.Ndarray] | None",
    ) -> None:
        """Count the voxels on every ray's way into ``begins``, or write cells and table (``into``)."""
        cells, table = into or (ti.ndarray(ti.i32, 1), ti.ndarray(ti.f32, (1, 1)))
        config, beam = self.inference, 0
        model = _RayFactors(self.voxel_size, self.sensor.max_depth, END_SIGMAS, config.floor + TINY)
        for keyframe, pixels in zip(keyframes, chosen, strict=True):
            image, visible, window = keyframe.image, keyframe.visible, keyframe.footprint.window
            if len(pixels) == 0:
                continue
            self.index.fill(window, visible.cells, self.rank[visible.slots])
            _follow(
                pixels, image.depth, image.sensor, window.viewpoint(keyframe.T_world_camera),
                self.index.space(window, self.volume.lower, self.volume.upper), model,
                beam, begins, cells, table, into is not None,
            )  # fmt: skip
            self.index.clear(window, visible.cells)
            beam += len(pixels)
