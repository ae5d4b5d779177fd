"""Rays through the grid agree with a NumPy oracle: which voxels, in which order, and for how long."""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles.traversal import clip_to_box, segments

from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, F32Array, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, CHUNK, VOXELS, offsets_in_brick
from taichi_mrf.voxels.traversal import Space, clip, make_ray, walk_bricks, walk_voxels

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.compilers]

EXACT = 1e-3
"""Largest error of a segment's length, in voxels."""

Shape = tuple[int, int, int]


@ti.dataclass
class _Record(Struct):
    begin: I32
    count: I32
    most: I32


@dataclass(frozen=True)
class _Kept(Bundle):
    index: I32Array
    near: F32Array
    far: F32Array
    shape: IVec3


@ti.func
def _keep_voxel(record: Template, kept: Template, index: I32, near: F32, far: F32):
    i = record.begin + record.count
    kept.index[i] = index
    kept.near[i] = near
    kept.far[i] = far
    record.count += 1
    return ti.cast(record.count < record.most, ti.i32)


@ti.func
def _keep_brick(record: Template, kept: Template, ray: Template, brick: IVec3, near: F32, far: F32):
    return _keep_voxel(
        record, kept, (brick[0] * kept.shape[1] + brick[1]) * kept.shape[2] + brick[2], near, far
    )


@kernel
def _walk(
    rays: AnyArray, space: Space, most: I32, room: I32, kept: _Kept, counts: I32Array,
    voxels: Template, skip_empty: Template, block: Template,
) -> None:  # fmt: skip
    if ti.static(block > 0):
        ti.loop_config(block_dim=block)
    for r in range(counts.shape[0]):
        ray = make_ray(Vec3(rays[r, 0], rays[r, 1], rays[r, 2]), Vec3(rays[r, 3], rays[r, 4], rays[r, 5]))
        begin, end = rays[r, 6], rays[r, 7]
        clip(ray, begin, end, space.lower, space.upper)
        record = _Record(r * room, 0, most)
        if ti.static(voxels):
            walk_voxels(ray, begin, end, space, _keep_voxel, record, kept)
        else:
            walk_bricks(ray, begin, end, space.shape, space.chunks, skip_empty, _keep_brick, record, kept)
        counts[r] = record.count


@kernel
def _clip(rays: AnyArray, lower: Vec3, upper: Vec3, found: F32Array) -> None:
    for r in range(rays.shape[0]):
        ray = make_ray(Vec3(rays[r, 0], rays[r, 1], rays[r, 2]), Vec3(rays[r, 3], rays[r, 4], rays[r, 5]))
        begin, end = rays[r, 6], rays[r, 7]
        clip(ray, begin, end, lower, upper)
        found[2 * r], found[2 * r + 1] = begin, end


@dataclass(frozen=True)
class Grid:
    """A window of bricks, some of which exist: ``slots`` (bricks,) holds -1 where none does."""

    shape: Shape
    slots: NDArray[np.int32]

    @property
    def chunks(self) -> NDArray[np.int32]:
        """1 for each chunk that holds a brick, row by row."""
        chunk_shape = tuple(n // CHUNK for n in self.shape)
        bricks = np.stack(np.unravel_index(np.flatnonzero(self.slots >= 0), self.shape))
        marks = np.zeros(chunk_shape, np.int32)
        marks[tuple(bricks // CHUNK)] = 1
        return marks.reshape(-1)

    def voxels_of(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """slot * 512 + number -> voxel in the window, (n, 3)."""
        cell_of_slot = np.zeros(self.slots.max() + 1, np.int64)
        cell_of_slot[self.slots[self.slots >= 0]] = np.flatnonzero(self.slots >= 0)
        bricks = np.stack(np.unravel_index(cell_of_slot[index // VOXELS], self.shape), axis=1)
        return bricks * BRICK + offsets_in_brick()[index % VOXELS]

    def exists(self, voxels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mask of the voxels (n, 3) that lie in a brick that exists."""
        return self.slots[np.ravel_multi_index(tuple(voxels.T // BRICK), self.shape)] >= 0


@dataclass(frozen=True)
class Walked:
    """All rays' segments, ray by ray: (n,) arrays; ``counts`` is (rays,)."""

    ray: NDArray[np.int64]
    cell: NDArray[np.int64]
    near: NDArray[np.float64]
    far: NDArray[np.float64]
    counts: NDArray[np.int32]


def full_grid(shape: Shape, seed: int = 0) -> Grid:
    """All bricks exist, in slots of no order."""
    return Grid(shape, np.random.default_rng(seed).permutation(np.prod(shape)).astype(np.int32))


def sparse_grid(shape: Shape, seed: int = 0) -> Grid:
    """A third of the chunks hold bricks, a few each."""
    random = np.random.default_rng(seed)
    bricks = np.stack(np.unravel_index(np.arange(np.prod(shape)), shape))
    busy = random.random(tuple(n // CHUNK for n in shape)) < 1 / 3
    wanted = busy[tuple(bricks // CHUNK)] & (random.random(bricks.shape[1]) < 0.1)
    slots = np.full(bricks.shape[1], -1, np.int32)
    slots[wanted] = random.permutation(wanted.sum())
    return Grid(shape, slots)


def walk(
    grid: Grid, rays: NDArray[np.float32], voxels: bool = True, skip: bool = True, most: int = 2**30
) -> Walked:
    """Let the engine walk rays (n, 8): origin, direction, begin and end."""
    room = min(most, 2 * sum(grid.shape) * (BRICK if voxels else 1) + 8)
    index = np.full(len(rays) * room, -1, np.int32)
    near, far = np.zeros(len(index), np.float32), np.zeros(len(index), np.float32)
    counts = np.zeros(len(rays), np.int32)
    shape = ti.Vector(grid.shape, ti.i32)
    upper = ti.Vector([float(n * BRICK) for n in grid.shape], ti.f32)
    space = Space(shape, ti.Vector([0.0] * 3, ti.f32), upper, grid.chunks, grid.slots)
    block = 8 if runtime.is_software() else 0
    _walk(rays, space, most, room, _Kept(index, near, far, shape), counts, voxels, skip, block)
    assert counts.max(initial=0) <= room
    written = (np.arange(room) < counts[:, None]).reshape(-1)
    return Walked(
        np.repeat(np.arange(len(rays)), counts), index[written].astype(np.int64),
        near[written].astype(np.float64), far[written].astype(np.float64), counts,
    )  # fmt: skip


def speed(rays: NDArray[np.float32]) -> NDArray[np.float64]:
    """Voxels for one unit of t."""
    return np.linalg.norm(rays[:, 3:6].astype(np.float64), axis=1)


def clipped(grid: Grid, ray: NDArray) -> tuple[float, float]:
    exact = ray.astype(np.float64)
    upper = np.array(grid.shape) * BRICK
    return clip_to_box(exact[:3], exact[3:6], exact[6], exact[7], np.zeros(3), upper)


def oracle(grid: Grid, rays: NDArray[np.float32], size: int = 1) -> Walked:
    """Expected finds of the engine, in float64: voxels, or with ``size`` BRICK bricks."""
    found = [segments(r[:3], r[3:6], *clipped(grid, r), size=size) for r in rays.astype(np.float64)]
    counts = np.array([len(near) for _, near, _ in found], np.int32)
    cells, near, far = (np.concatenate(parts) for parts in zip(*found, strict=True))
    shape = np.array(grid.shape) * (BRICK // size)
    # A segment that rounding puts just outside the window is of no length.
    numbers = np.ravel_multi_index(tuple(np.clip(cells, 0, shape - 1).T), shape)
    return Walked(np.repeat(np.arange(len(rays)), counts), numbers, near, far, counts)


def lengths_of(walked: Walked, rays: NDArray[np.float32]) -> NDArray[np.float64]:
    """Segments' lengths in voxels."""
    return (walked.far - walked.near) * speed(rays)[walked.ray]


def largest_difference(a: Walked, b: Walked, rays: NDArray[np.float32]) -> float:
    """Of the lengths, in voxels, of the same ray in the same cell; a cell that is missing counts as 0."""
    cells = 1 + max(a.cell.max(initial=0), b.cell.max(initial=0))
    keys = np.concatenate([w.ray * cells + w.cell for w in (a, b)])
    _, number = np.unique(keys, return_inverse=True)
    signed = np.concatenate([lengths_of(a, rays), -lengths_of(b, rays)])
    return float(np.abs(np.bincount(number, signed)).max())


def assert_agrees(grid: Grid, rays: NDArray[np.float32], sums_to: float = EXACT) -> Walked:
    """The engine's walk has the oracle's voxels, lengths and sums, and goes one way."""
    expected = oracle(grid, rays)
    shape = np.array(grid.shape) * BRICK
    here = grid.exists(np.stack(np.unravel_index(expected.cell, shape), axis=1))
    expected = Walked(expected.ray[here], expected.cell[here], expected.near[here], expected.far[here],
                      np.bincount(expected.ray[here], minlength=len(rays)).astype(np.int32))  # fmt: skip
    walked = walk(grid, rays)
    voxels = np.ravel_multi_index(tuple(grid.voxels_of(walked.cell).T), shape)
    found = Walked(walked.ray, voxels, walked.near, walked.far, walked.counts)
    assert largest_difference(found, expected, rays) < EXACT
    assert len(np.unique(found.ray * shape.prod() + voxels)) == len(voxels)  # no voxel twice
    sums, clipped_sums = (
        np.bincount(w.ray, lengths_of(w, rays), minlength=len(rays)) for w in (found, expected)
    )
    np.testing.assert_allclose(sums, clipped_sums, rtol=0, atol=sums_to)
    assert (found.far > found.near).all()
    same_ray = found.ray[1:] == found.ray[:-1]
    assert (found.near[1:] >= found.far[:-1])[same_ray].all()
    return walked


def assert_contiguous(grid: Grid, rays: NDArray[np.float32], walked: Walked) -> None:
    """With all bricks in existence, a ray's segments fill its clipped interval without a gap."""
    tolerance = EXACT / speed(rays)
    same_ray = walked.ray[1:] == walked.ray[:-1]
    gaps = walked.near[1:] - walked.far[:-1]
    assert (gaps <= tolerance[walked.ray[1:]])[same_ray].all()
    ends = np.cumsum(walked.counts)
    for r in np.flatnonzero(walked.counts):
        begin, end = clipped(grid, rays[r])
        assert abs(walked.near[ends[r] - walked.counts[r]] - begin) <= tolerance[r]
        assert abs(walked.far[ends[r] - 1] - end) <= tolerance[r]


def random_rays(grid: Grid, count: int, seed: int) -> NDArray[np.float32]:
    """Rays that start inside and outside the window, at every speed, most of them aimed into it."""
    random = np.random.default_rng(seed)
    size = np.array(grid.shape) * BRICK
    origins = random.uniform(-0.3, 1.3, (count, 3)) * size
    directions = random.uniform(0, 1, (count, 3)) * size - origins
    directions *= np.exp(random.uniform(-3, 3, (count, 1))) / np.linalg.norm(directions, axis=1)[:, None]
    end = random.uniform(0.1, 2.0, count) * size.max() / np.linalg.norm(directions, axis=1)
    return np.column_stack([origins, directions, np.zeros(count), end]).astype(np.float32)


def many(backend: str, on_cpu: int, elsewhere: int) -> int:
    return on_cpu if backend == "cpu" else elsewhere


def test_random_rays_through_a_full_window(backend: str) -> None:
    grid = full_grid((16, 16, 8))
    rays = random_rays(grid, many(backend, 20000, 1500), seed=1)
    walked = assert_agrees(grid, rays)
    assert (walked.counts > 0).mean() > 0.6
    assert_contiguous(grid, rays, walked)


def test_random_rays_through_a_sparse_window(backend: str) -> None:
    grid = sparse_grid((32, 24, 16), seed=2)
    walked = assert_agrees(grid, random_rays(grid, many(backend, 10000, 1000), seed=3))
    assert (walked.counts > 0).mean() > 0.2


def test_a_window_of_a_thousand_voxels_is_as_exact(backend: str) -> None:
    grid = full_grid((128, 8, 8))
    rays = random_rays(grid, many(backend, 3000, 300), seed=4)
    # From brick to brick the last digit of t is lost, along a thousand voxels 150 times.
    last_digits = 2 * np.spacing(np.float32(1024)) * 150
    assert_contiguous(grid, rays, assert_agrees(grid, rays, last_digits))


def test_rays_that_start_inside_a_brick_or_end_in_one(backend: str) -> None:
    grid = full_grid((8, 8, 8))
    rays = random_rays(grid, many(backend, 3000, 500), seed=5)
    rays[:, :3] = np.random.default_rng(6).uniform(24, 40, (len(rays), 3))
    rays[:, 7] = np.random.default_rng(7).uniform(0.01, 20, len(rays)) / speed(rays)
    walked = assert_agrees(grid, rays)
    assert (walked.counts > 0).all()
    assert_contiguous(grid, rays, walked)


DIRECTIONS = np.array([d for d in product((-1, 0, 1), repeat=3) if any(d)], np.float64)


@pytest.mark.parametrize(
    "starts",
    [
        pytest.param((0.0, 8.0, 16.0, 61.0, 64.0), id="lattice points"),
        pytest.param((4.0, 63.0, 64.0, 127.0), id="both sides of chunk faces"),
        pytest.param((0.5, 8.0, 63.5), id="faces and centres"),
        pytest.param((-3.0, 64.0, 131.0), id="outside the window"),
    ],
)
def test_axis_parallel_and_diagonal_rays_through_faces_edges_and_corners(starts: tuple[float, ...]) -> None:
    """All 26 directions from points on the lattice, where ties decide; a face belongs to the voxel above."""
    grid = full_grid((16, 16, 16))
    origins = np.array(list(product(starts, repeat=3)))
    o, d = np.repeat(origins, len(DIRECTIONS), axis=0), np.tile(DIRECTIONS, (len(origins), 1))
    rays = np.column_stack([o, d, np.zeros(len(o)), np.full(len(o), 300.0)]).astype(np.float32)
    walked = assert_agrees(grid, rays)
    assert (walked.counts > 0).sum() > len(rays) / 10
    assert_contiguous(grid, rays, walked)


def test_lattice_rays_of_whole_numbers(backend: str) -> None:
    """Directions such as (1, 2, -3) meet edges and corners again and again, away from the diagonals."""
    grid = full_grid((16, 8, 8))
    random = np.random.default_rng(8)
    count = many(backend, 4000, 500)
    directions = random.integers(-4, 5, (count, 3))
    directions[~directions.any(axis=1)] = (1, 2, -3)
    origins = random.integers(0, np.array(grid.shape) * BRICK, (count, 3))
    rays = np.column_stack([origins, directions, np.zeros(count), np.full(count, 200)]).astype(np.float32)
    assert_contiguous(grid, rays, assert_agrees(grid, rays))


def test_nearly_axis_parallel_rays(backend: str) -> None:
    grid = full_grid((16, 8, 8))
    random = np.random.default_rng(9)
    count = many(backend, 3000, 500)
    directions = random.choice([-1.0, 1.0], (count, 3)) * 10.0 ** random.uniform(-20, -3, (count, 3))
    directions[np.arange(count), random.integers(0, 3, count)] = random.choice([-1.0, 1.0], count)
    origins = random.uniform(0.01, 0.99, (count, 3)) + random.integers(0, 64, (count, 3))
    rays = np.column_stack([origins, directions, np.zeros(count), np.full(count, 150)]).astype(np.float32)
    assert_contiguous(grid, rays, assert_agrees(grid, rays))


def test_a_reversed_ray_has_the_same_voxels_and_lengths(backend: str) -> None:
    """Between points that float32 holds exactly, so that both ways are the same line."""
    grid = full_grid((16, 16, 16), seed=10)
    random = np.random.default_rng(11)
    count = many(backend, 4000, 500)
    origins = random.integers(-40 * 64, 168 * 64, (count, 3)) / 64
    directions = random.integers(-128, 129, (count, 3)) / 64
    directions[~directions.any(axis=1)] = 1
    steps = random.integers(8, 64, count).astype(np.float64)
    there = np.column_stack([origins, directions, np.zeros(count), steps]).astype(np.float32)
    back = np.column_stack([origins + steps[:, None] * directions, -directions, there[:, 6:]])
    forth, reverse = walk(grid, there), walk(grid, back.astype(np.float32))
    assert (forth.counts > 0).mean() > 0.3
    # A ray that lies in a face counts for the voxel above it, whichever way it goes.
    assert largest_difference(forth, reverse, there) < EXACT


def test_skipping_empty_chunks_changes_nothing(backend: str) -> None:
    grid = sparse_grid((32, 16, 16), seed=12)
    rays = random_rays(grid, many(backend, 5000, 500), seed=13)
    skipping, stepping = (walk(grid, rays, voxels=False, skip=skip) for skip in (True, False))
    exists = grid.slots >= 0
    kept, all_kept = exists[skipping.cell], exists[stepping.cell]
    assert len(skipping.cell) < len(stepping.cell) / 2
    assert kept.sum() > 1000 if backend == "cpu" else kept.any()
    for name in ("ray", "cell", "near", "far"):
        np.testing.assert_array_equal(getattr(skipping, name)[kept], getattr(stepping, name)[all_kept])


def test_bricks_are_those_of_the_oracle(backend: str) -> None:
    grid = full_grid((16, 16, 8))
    rays = random_rays(grid, many(backend, 4000, 500), seed=14)
    walked = walk(grid, rays, voxels=False, skip=False)
    assert largest_difference(walked, oracle(grid, rays, BRICK), rays) < EXACT


@pytest.mark.parametrize("make", [full_grid, sparse_grid])
def test_a_visitor_can_end_the_walk(make: Callable[[Shape, int], Grid]) -> None:
    grid = make((16, 16, 16), 15)
    rays = random_rays(grid, 300, seed=16)
    whole = walk(grid, rays)
    for most in (1, 2, 17):
        part = walk(grid, rays, most=most)
        np.testing.assert_array_equal(part.counts, np.minimum(whole.counts, most))
        begins = np.cumsum(whole.counts) - whole.counts
        first = np.concatenate([np.arange(b, b + n) for b, n in zip(begins, part.counts, strict=True)])
        np.testing.assert_array_equal(part.cell, whole.cell[first])
        np.testing.assert_array_equal(part.far, whole.far[first])


@pytest.mark.parametrize("rest", [0.0, -0.0, 1e-15, -1e-15, 1e-11, -1e-11])
def test_an_axis_parallel_ray_may_carry_rounding_errors(rest: float) -> None:
    """The other two components of a camera axis turned by 90 degrees are 1e-17 of either sign, not 0."""
    grid = full_grid((8, 8, 8))
    for axis in range(3):
        ray = np.array([[20.5, 20.5, 20.5, rest, rest, rest, 0, 30]], np.float32)
        ray[0, 3 + axis] = 1
        cells = np.full((31, 3), 20)
        cells[:, axis] += np.arange(31)
        np.testing.assert_array_equal(grid.voxels_of(walk(grid, ray).cell), cells)


def test_an_interval_outside_the_window_meets_nothing() -> None:
    grid = full_grid((8, 8, 8))
    away = [[70, 5, 5, 1, 0, 0, 0, 50], [-9, 5, 5, 1, 0, 0, 0, 8], [5, 5, 5, 1, 1, 1, 9, 9]]
    in_upper_face = [[5, 64, 5, 1, 0, 0, 0, 50]]
    assert walk(grid, np.array(away + in_upper_face, np.float32)).counts.tolist() == [0, 0, 0, 0]


def test_clip_keeps_the_part_inside_the_box() -> None:
    """Rays that begin or end inside, pass through, and miss the box."""
    random = np.random.default_rng(3)
    rays = random.uniform(-3, 3, (500, 8)).astype(np.float32)
    rays[:, 6], rays[:, 7] = random.uniform(0, 0.5, 500), random.uniform(0.5, 6, 500)
    lower, upper = np.array([-1.0, -2.0, -1.5]), np.array([1.5, 1.0, 2.0])
    found = np.zeros(1000, np.float32)
    _clip(rays, ti.Vector(lower.tolist(), ti.f32), ti.Vector(upper.tolist(), ti.f32), found)
    expected = np.array(
        [clip_to_box(r[:3], r[3:6], r[6], r[7], lower, upper) for r in rays.astype(np.float64)]
    )
    inside = expected[:, 0] < expected[:, 1]
    assert 50 < inside.sum() < 400
    assert (
        len({(a == r[6], b == r[7]) for (a, b), r in zip(expected[inside], rays[inside], strict=True)}) == 4
    )
    np.testing.assert_allclose(found.reshape(-1, 2)[inside], expected[inside], rtol=1e-5, atol=1e-5)
    assert (found.reshape(-1, 2)[~inside, 0] >= found.reshape(-1, 2)[~inside, 1]).all()
