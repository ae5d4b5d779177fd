"""Bounds for free space with a promise (queries/free.py), from frames that a map has not seen.

Of the voxels that a held-out frame looks into and that the map calls free, some have a measured end in them.
Their share is found for each step of log-odds and made to rise with them (isotonic regression); a level p is
bounded where the share passes 1 - p. So it holds for the least sure voxels that are called free at p, and all
the more for all of them together. Far from surfaces nearly all is free, and a share of the whole would say
nothing of the voxels beside a wall.

Frames, not voxels or rays, are exchangeable: a pose that is off moves all ends of a frame. Each held-out
frame stands for a block of the recording, and as in conformal risk control the block that is still to come
counts, as the worst of those that are known: the frame that allows the least counts twice.

Ends are averaged over the pixels around that lie in one plane with them, to within their noise, and have to
be some of the rays that go through the voxel: a single end lies in front of its wall by a sigma or two, and a
voxel of 5 cm at 2 m has a hundred of them. What is assumed: matter is measured where a frame looks at it. A
voxel whose matter hardly any held-out pixel meets counts as free, and one in which averaged ends still lie by
noise counts as matter; docs/free.md compares with the truth.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.held_out import surface_depth
from taichi_mrf.methods.protocol import PosedDepth
from taichi_mrf.queries.free import LEVELS, NEVER, FreePromise, states_at
from taichi_mrf.queries.known_bricks import known_bricks
from taichi_mrf.queries.points import FREE
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.voxels.layout import BRICK, VOXELS, grid_keys

STEPS = np.arange(-12.0, 0.01, 0.125)
"""Log-odds between the bins in which shares are counted."""

LEAST_BLOCKS = 3
"""With fewer frames nothing is promised by them."""

MOST_FRAMES = 10
"""Frames that are looked at."""

AROUND = 2
"""Pixels to each side over which ends are averaged."""

SAME_SURFACE = 3.0
"""Standard deviations by which the mean of two opposite neighbours may differ from the pixel between them."""

MOST_SIGMA = 0.25
"""In voxels: an end that is less certain does not tell which voxel it is in, and its ray does not count."""

LEAST_SHARE = 0.05
"""Of the rays through a voxel, so many end in it where it counts as matter: the tails of noise are fewer."""

MOST_ENDS = 80_000
"""Of larger images every second pixel's end counts, or every third, ..., averaged over all around."""

VOXELS_SAMPLED = 150_000
"""Known voxels that are projected into each frame."""

BALL = 0.62
"""Radius in voxels of the ball that is as large as a voxel: a ray that passes so near goes through it."""

LEAST_VOXELS = 3.0
"""Without a single end, so many times 1 / (1 - p) voxels show a share of at most 1 - p, 19 times in 20."""

_RAYS, _REACH_M, _RAY_STEP = 400, 1.0, 0.25

Counts = NDArray[np.float64]


def calibrate_free(m: Any, frames: Iterable[PosedDepth]) -> FreePromise | None:
    """The bounds of a finished map, from frames that were kept out of it, of which MOST_FRAMES count at most.

    ``m.promise`` takes the answer. None if there are fewer than LEAST_BLOCKS frames that look into free
    space. Raises ConfigError for a map that is not settled.
    """
    if not m.settled:
        raise ConfigError("the map is not settled: call infer() before its free space is calibrated")
    decided = m.decided
    known = _Known(m, decided)
    found = [_count(m, decided, known, frame) for frame in frames]
    found = [each for each in found if each[1].sum() > 0]
    if len(found) < LEAST_BLOCKS:
        return None
    ends, visited = (np.array([each[i] for each in found]) for i in (0, 1))
    bounds = bounds_of(ends, visited)
    held = held_share(ends, visited)
    lost = np.concatenate([each[2] for each in found])
    return FreePromise(
        levels=np.array(LEVELS),
        bound=bounds,
        held_least=held.min(axis=0),
        held_most=held.max(axis=0),
        # A ray's free stretch has log-odds (rays, steps); NaN where it is not free.
        lost_m=np.array([_lost(lost, bound) for bound in bounds]) * _RAY_STEP * m.voxel_size,
        blocks=len(found),
    )


def spread_frames(indices: Sequence[int]) -> list[int]:
    """At most MOST_FRAMES of some frames' indices, evenly spread."""
    count = min(len(indices), MOST_FRAMES)
    return [indices[(2 * k + 1) * len(indices) // (2 * count)] for k in range(count)]


def bounds_of(ends: Counts, visited: Counts) -> Counts:
    """Bounds for LEVELS, (levels,), from counts (blocks, bins) of free voxels that are visited, and of those
    with an end; bins ascend in log-odds, and bin i ends at STEPS[i], the last nowhere."""
    uppers = np.append(STEPS, np.inf)
    bounds = []
    for level in LEVELS:
        most = 1.0 - level
        # The block whose own bound is lowest; of several, the one with the largest share of ends.
        own = [_bins_allowed(*block, most) for block in zip(ends, visited, strict=True)]
        share = ends.sum(axis=1) / np.maximum(visited.sum(axis=1), 1)
        worst = min(range(len(own)), key=lambda b: (own[b], -share[b]))
        bins = _bins_allowed(ends.sum(0) + ends[worst], visited.sum(0) + visited[worst], most)
        enough = visited[:, :bins].sum() >= LEAST_VOXELS / most
        bounds.append(uppers[bins - 1] if bins and enough else NEVER)
    return np.minimum.accumulate(np.minimum(bounds, STEPS[-1]))


def held_share(ends: Counts, visited: Counts) -> Counts:
    """Of the voxels that each block visits and that are free at LEVELS by the bounds of the other blocks, the
    share without an end, (blocks, levels); 1 where there are none."""
    held = np.ones((len(ends), len(LEVELS)))
    for block in range(len(ends)):
        others = np.arange(len(ends)) != block
        for i, bound in enumerate(bounds_of(ends[others], visited[others])):
            bins = int(np.searchsorted(STEPS, bound, side="right"))
            bins = len(STEPS) + 1 if bound >= STEPS[-1] else bins
            there = visited[block, :bins].sum()
            held[block, i] = 1.0 - ends[block, :bins].sum() / there if there else 1.0
    return np.clip(held, 0.0, 1.0)


def _bins_allowed(ends: Counts, visited: Counts, most: float) -> int:
    """Number of bins, from the first on, whose share of ends, which rises, is at most ``most``."""
    allowed = rising_share(ends, visited) <= most
    return len(allowed) if allowed.all() else int(np.argmin(allowed))


def rising_share(ends: Counts, visited: Counts) -> Counts:
    """The share of ends for each bin, (n,), that never falls and is nearest to what was counted, weighted by
    ``visited`` (pool adjacent violators)."""
    pools: list[list[float]] = []
    for end, seen in zip(ends.tolist(), visited.tolist(), strict=True):
        pools.append([end, seen, 1])
        while len(pools) > 1 and pools[-2][0] * pools[-1][1] >= pools[-1][0] * pools[-2][1]:
            end, seen, bins = pools.pop()
            pools[-1] = [pools[-1][0] + end, pools[-1][1] + seen, pools[-1][2] + bins]
    share = [end / seen if seen else 0.0 for end, seen, _ in pools]
    return np.repeat(share, [int(bins) for *_, bins in pools])


class _Known:
    """A sample of the known voxels that are free: centres (n, 3) in metres, the bin of each (n,), and how
    many voxels one of them stands for."""

    def __init__(self, m: Any, decided: Any) -> None:
        bricks = known_bricks(m).astype(np.int64)
        count = len(bricks) * VOXELS
        stride = max(1, count // VOXELS_SAMPLED) | 1  # odd, so that it meets all voxels of a brick
        number = np.arange(0, count, stride)
        inner = np.stack(np.unravel_index(number % VOXELS, (BRICK,) * 3), axis=1)
        centres_m = (bricks[number // VOXELS] * BRICK + inner + 0.5) * m.voxel_size
        log_odds, state = states_at(decided, centres_m)
        self.centres_m, self.bin = centres_m[state == FREE], _bin(log_odds[state == FREE])
        self.each = float(stride)


def _bin(log_odds: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.searchsorted(STEPS, log_odds, side="right")


def _count(
    m: Any, decided: Any, known: _Known, frame: PosedDepth
) -> tuple[Counts, Counts, NDArray[np.float64]]:
    """Free voxels with an end, and those that are visited, by bin (bins,), and the log-odds along rays in
    front of their ends (rays, steps)."""
    noise = m.noise if frame.own.noise is None else frame.own.noise
    camera, T = frame.camera, frame.T_world_camera
    depth_m = surface_depth(frame, m.noise)
    depth_m[(frame.depth_m <= 0) | (frame.depth_m > m.sensor.max_depth)] = 0
    sigma_m, _ = noise.table(camera).at_pixels(depth_m)
    if frame.own.sigma_m is not None:
        sigma_m = np.where(frame.own.sigma_m > 0, frame.own.sigma_m, sigma_m)
    bins, rays = len(STEPS) + 1, camera.rays()
    step = int(np.ceil(np.sqrt(depth_m.size / MOST_ENDS)))
    ends_m = certain_ends(depth_m, sigma_m, m.voxel_size)
    depth_m = np.where(ends_m > 0, depth_m, 0)  # a ray that says nothing of its end says nothing at all
    ends_m, some_rays = ends_m[::step, ::step], rays[::step, ::step]
    voxels = _ended_in(some_rays, ends_m, T, m.voxel_size)
    log_odds, state = states_at(decided, (voxels + 0.5) * m.voxel_size)
    ends = np.bincount(_bin(log_odds[state == FREE]), minlength=bins).astype(np.float64)
    seen = _sees(camera, rays, depth_m, (known.centres_m - T[:3, 3]) @ T[:3, :3], m.voxel_size)
    visited = known.each * np.bincount(known.bin[seen], minlength=bins)
    return ends, np.maximum(visited, ends), _before_ends(m, decided, some_rays, ends_m, T)


def averaged(
    depth_m: NDArray[np.floating], sigma_m: NDArray[np.floating], apart: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth averaged over pairs of opposite pixels around each that lie in one plane with it to within its
    noise, and its standard deviation, (H, W) each; 0 where nothing was measured. An edge and a thin thing
    keep their depth. Pixels are ``apart`` columns and rows from each other."""
    depth = np.asarray(depth_m, np.float64)
    total, pairs = depth.copy(), np.zeros(depth.shape, np.uint8)
    height, width = depth.shape
    margin, most = AROUND * apart, SAME_SURFACE * sigma_m
    padded = np.pad(depth, margin)
    measured = padded > 0
    for down in range(0, margin + 1, apart):
        for right in range(-margin, margin + 1, apart):
            if (down, right) <= (0, 0):
                continue
            there, opposite = (
                (slice(margin + y, margin + y + height), slice(margin + x, margin + x + width))
                for y, x in ((down, right), (-down, -right))
            )
            both = padded[there] + padded[opposite]
            same = (np.abs(0.5 * both - depth) < most) & measured[there] & measured[opposite]
            total += np.where(same, both, 0.0)
            pairs += same
    count = 1.0 + 2.0 * pairs
    return np.where(depth > 0, total / count, 0.0), sigma_m / np.sqrt(count)


def certain_ends(
    depth_m: NDArray[np.floating], sigma_m: NDArray[np.floating], voxel_size: float
) -> NDArray[np.float64]:
    """Averaged depth (H, W), 0 where its standard deviation is more than MOST_SIGMA voxels."""
    measured = depth_m > 0
    ends_m, ends_sigma_m = averaged(depth_m, sigma_m)
    if measured.any() and np.median(ends_sigma_m[measured]) > 0.5 * MOST_SIGMA * voxel_size:
        ends_m, ends_sigma_m = averaged(ends_m, ends_sigma_m, 2 * AROUND + 1)
    return np.where(ends_sigma_m <= MOST_SIGMA * voxel_size, ends_m, 0.0)


def _ended_in(
    rays: NDArray[np.float64], ends_m: NDArray[np.float64], T: NDArray[np.float64], voxel_size: float
) -> NDArray[np.int64]:
    """The voxels (n, 3) in which at least LEAST_SHARE of the rays end that go through them."""
    measured = ends_m > 0
    points_m = (rays[measured] * ends_m[measured][:, None]) @ T[:3, :3].T + T[:3, 3]
    voxels = np.floor(points_m / voxel_size).astype(np.int32)
    _, first, count = np.unique(grid_keys(voxels), return_index=True, return_counts=True)
    through = (voxel_size / ends_m[measured][first]) ** 2 * _rays_in_area(rays)[measured][first]
    return voxels[first[count >= LEAST_SHARE * through]].astype(np.int64)


def _rays_in_area(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays per square metre at a depth of one metre, around each pixel, (H, W); 0 where unknown."""
    if min(rays.shape[:2]) < 2:
        return np.zeros(rays.shape[:2])
    apart = [_lengths(np.gradient(rays, axis=axis)) for axis in (0, 1)]
    return 1.0 / np.maximum(apart[0] * apart[1], 1e-12)


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of vectors (..., 3), as np.linalg.norm gives them in seven times the time."""
    x, y, z = (vectors[..., axis] for axis in range(3))
    return np.sqrt(x * x + y * y + z * z)


def _sees(
    camera: Camera,
    rays: NDArray[np.float64],
    depth_m: NDArray[np.floating],
    points_m: NDArray[np.float64],
    voxel_size: float,
) -> NDArray[np.bool_]:
    """True for voxels that a measured ray passes or ends in: centres (n, 3), camera frame -> (n,)."""
    flat, measured_m = rays.reshape(-1, 3), np.asarray(depth_m).reshape(-1)
    if isinstance(camera, RayTable):
        from scipy.spatial import cKDTree  # takes a third of a second to import

        units = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        lengths = np.maximum(np.linalg.norm(points_m, axis=1, keepdims=True), 1e-9)
        pixel, inside = cKDTree(units).query(points_m / lengths)[1], np.ones(len(points_m), np.bool_)
    else:
        columns, rows, _ = camera.project(points_m).T
        inside = np.isfinite(columns)
        u, v = (np.rint(np.where(inside, at, 0)).astype(np.int64) for at in (columns, rows))
        u %= camera.width
        pixel = np.clip(v, 0, camera.height - 1) * camera.width + u
    ray = flat[pixel]
    along = np.einsum("ij,ij->i", points_m, ray) / np.einsum("ij,ij->i", ray, ray)
    apart = _lengths(points_m - along[:, None] * ray)
    until = measured_m[pixel] + BALL * voxel_size / _lengths(ray)
    return inside & (measured_m[pixel] > 0) & (along > 0) & (along < until) & (apart < BALL * voxel_size)


def _before_ends(
    m: Any, decided: Any, rays: NDArray[np.float64], ends_m: NDArray[np.float64], T: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log-odds at steps back from the ends of some rays, (rays, steps); NaN where it is not free."""
    pixels = np.flatnonzero(ends_m)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(_RAYS, len(pixels))).astype(np.int64)]
    ways = rays.reshape(-1, 3)[pixels] @ T[:3, :3].T
    units = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    step_m = _RAY_STEP * m.voxel_size
    back_m = np.arange(step_m, max(_REACH_M, 8 * m.voxel_size), step_m)
    ends = T[:3, 3] + ways * ends_m.reshape(-1)[pixels, None]
    points_m = ends[:, None] - back_m[:, None] * units[:, None]
    log_odds, state = states_at(decided, points_m.reshape(-1, 3))
    return np.where(state == FREE, log_odds, np.nan).reshape(len(pixels), len(back_m))


def _lost(log_odds: NDArray[np.float64], bound: float) -> float:
    """Steps of a ray that are free but not below a bound, on average."""
    return float((log_odds >= bound).sum(axis=1).mean()) if len(log_odds) else 0.0
