"""The inference of taichi_mrf in float64 NumPy, ray by ray and voxel by voxel, to compare kernels with.

Written for clarity and from the equations, not from the kernels: it shares no code with them but the
definition of parameters.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oracles.forward import Noise
from oracles.traversal import segments
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.ray_model import Limits
from taichi_mrf.sensor.camera import PinholeCamera

# Written out, and not imported: these tests hold the values.
CLEAR_VOXELS = 2.0
END_SIGMAS = 3.0
SUPPORT = 6.5

Voxel = tuple[int, int, int]


@dataclass(frozen=True)
class Segment:
    """Length of a ray in one voxel, in voxel sizes."""

    voxel: Voxel
    length: float


@dataclass(frozen=True)
class Ray:
    """A ray with its measurement. ``beyond`` is the density of the measurement if the first surface lies
    past the last segment. Voxels that are not in ``told`` get no message, if it is given."""

    segments: list[Segment]
    densities: list[float]
    beyond: float
    told: frozenset[Voxel] | None = None


@dataclass(frozen=True)
class Group:
    """Rays with a shared path through the middle of their pixels; their own ways begin where it ends."""

    common: list[Segment]
    rays: list[Ray]
    told: None = None

    @property
    def segments(self) -> list[Segment]:
        return self.common + [segment for ray in self.rays for segment in ray.segments]


def cast_as_group(
    depth_m: NDArray[np.float32],
    T: NDArray[np.float64],
    camera: PinholeCamera,
    voxel_size: float,
    noise: Noise,
    max_depth: float,
) -> Group:
    """All rays of a depth image without a gap as one group."""
    height, width = camera.shape
    middle = T[:3, :3] @ np.array(
        [((width - 1) / 2 - camera.cx) / camera.fx, ((height - 1) / 2 - camera.cy) / camera.fy, 1.0]
    )
    nearest = min(float(noise.depth_of_deviation(float(depth), SUPPORT)) for depth in depth_m.flat)
    apart = max(0.0, min(nearest, max_depth) - CLEAR_VOXELS * voxel_size / float(np.linalg.norm(middle)))
    common, _, _ = _crossed(T[:3, 3], middle, 0.0, apart, voxel_size)
    return Group(common, cast(depth_m, T, camera, voxel_size, noise, max_depth, apart))


def cast(
    depth_m: NDArray[np.float32],
    T: NDArray[np.float64],
    camera: PinholeCamera,
    voxel_size: float,
    noise: Noise,
    max_depth: float,
    begin: float = 0.0,
) -> list[Ray]:
    """All rays of a depth image from depth ``begin`` on, with the likelihood of each segment."""
    rays = []
    directions = camera.rays()
    for v, u in np.argwhere(depth_m > 0):
        measured = float(depth_m[v, u])
        direction = T[:3, :3] @ directions[v, u]
        last = float(noise.depth_of_deviation(measured, -END_SIGMAS))
        end = min(last, max_depth)
        crossed, near, far = _crossed(T[:3, 3], direction, begin, end, voxel_size)
        centre = 0.5 * (near + far)
        density = np.where(
            noise.sigma_at(centre) < voxel_size,
            noise.density_over(measured, near, far),
            noise.density_at(measured, centre),
        )
        beyond = 0.0
        if end < last:
            likeliest = max(end, float(noise.depth_of_deviation(measured, 0.0)))
            beyond = float(noise.density_at(measured, likeliest))
        rays.append(Ray(crossed, density.tolist(), beyond))
    return rays


def _crossed(
    origin: NDArray[np.float64], direction: NDArray[np.float64], begin: float, end: float, voxel_size: float
) -> tuple[list[Segment], NDArray[np.float64], NDArray[np.float64]]:
    """The segments of a ray, and the depths at which they begin and end."""
    cells, near, far = segments(origin, direction, begin, end, voxel_size)
    lengths = (far - near) * np.linalg.norm(direction) / voxel_size
    voxels = [(int(i), int(j), int(k)) for i, j, k in cells]
    return [Segment(*each) for each in zip(voxels, lengths.tolist(), strict=True)], near, far


def logit(p: float) -> float:
    return math.log(p / (1 - p))


def logistic(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def ray_messages(
    ray: Ray, incoming: dict[Voxel, float], config: InferenceConfig, limits: Limits
) -> list[tuple[Voxel, float, float]]:
    """Eqs. 11, 13 and 14 for one ray: (voxel, weight, probability of occupied) for each segment.

    ``incoming`` are log-odds of the voxels as the ray sees them; voxels that it does not hold do not
    exist, and the ray passes through them.
    """
    return _messages_from(1.0, ray, incoming, config, limits)[0]


def group_messages(
    group: Group, incoming: dict[Voxel, float], config: InferenceConfig, limits: Limits
) -> list[tuple[Voxel, float, float]]:
    """Messages of a group: the shared path counts for each of its rays, and has the mean of what lies
    behind them."""
    passed, visibility = [], 1.0
    for segment in group.common:
        if segment.voxel in incoming:
            m = (1 - (config.pass_through or 0.0)) * logistic(incoming[segment.voxel])
            passed.append((segment, (1 - m) ** (segment.length if limits.segment_lengths else 1.0)))
            visibility *= passed[-1][1]
    out, behind = [], []
    for ray in group.rays:
        messages, beyond = _messages_from(visibility, ray, incoming, config, limits)
        out += messages
        behind.append(beyond)
    for segment, free in passed:
        empty = float(np.mean(behind)) / free + config.floor
        occupied = config.floor
        occupied += (config.pass_through or 0.0) * (empty - occupied)
        weight = segment.length if limits.segment_lengths else 1.0
        out.append((segment.voxel, weight * len(group.rays), occupied / (occupied + empty)))
    return out


def _messages_from(
    visibility: float, ray: Ray, incoming: dict[Voxel, float], config: InferenceConfig, limits: Limits
) -> tuple[list[tuple[Voxel, float, float]], float]:
    """The messages of a ray that begins with a ``visibility``, and the density that lies behind its start."""
    steps = []
    explained = 0.0
    for segment, density in zip(ray.segments, ray.densities, strict=True):
        if segment.voxel not in incoming:
            continue
        m = (1 - (config.pass_through or 0.0)) * logistic(incoming[segment.voxel])
        length = segment.length if limits.segment_lengths else 1.0
        free = (1 - m) ** length
        steps.append((segment, free, density * visibility, explained))
        explained += (1 - free) * density * visibility
        visibility *= free
    behind = ray.beyond * visibility
    out = []
    for segment, free, here, before in reversed(steps):
        occupied = before + here + config.floor
        empty = before + behind / free + config.floor
        occupied += (config.pass_through or 0.0) * (empty - occupied)
        weight = segment.length if limits.segment_lengths else 1.0
        out.append((segment.voxel, weight, occupied / (occupied + empty)))
        behind += (1 - free) * here
    return out, behind


def infer(
    keyframes: list[list[Ray]] | list[list[Group]],
    voxels: set[Voxel],
    prior: float,
    config: InferenceConfig,
    limits: Limits,
) -> dict[Voxel, float]:
    """Gauss-Seidel sweeps over keyframes with average messages; returns each voxel's log-odds."""
    belief = dict.fromkeys(voxels, logit(prior))
    clamp = limits.cavity
    lowest = max(-clamp, logit(config.free_share * prior)) if config.free_share > 0 else -clamp
    sent: list[dict[Voxel, float]] = [{} for _ in keyframes]
    for _ in range(config.sweeps):
        for rays, messages in zip(keyframes, sent, strict=True):
            seen = {s.voxel for ray in rays for s in ray.segments if s.voxel in belief}
            incoming = {v: min(clamp, max(lowest, belief[v] - messages.get(v, 0.0))) for v in seen}
            weights: dict[Voxel, float] = dict.fromkeys(seen, 0.0)
            sums: dict[Voxel, float] = dict.fromkeys(seen, 0.0)
            for ray in rays:
                messages_of = group_messages if isinstance(ray, Group) else ray_messages
                for voxel, weight, q in messages_of(ray, incoming, config, limits):
                    if ray.told is not None and voxel not in ray.told:
                        continue
                    log_odds = logit(min(1 - 1e-16, max(1e-300, q)))
                    weights[voxel] += weight
                    sums[voxel] += weight * min(limits.message, max(-limits.message, log_odds))
            for voxel in seen:
                if weights[voxel] <= limits.length:
                    continue
                old = messages.get(voxel, 0.0)
                messages[voxel] = sums[voxel] / weights[voxel]
                belief[voxel] += messages[voxel] - old
    return belief


def enumerate_marginals(
    rays: list[Ray], prior: float, floor: float, pass_through: float = 0.0
) -> dict[Voxel, float]:
    """Eq. 1 summed over every assignment of the voxels: exact marginals of occupied.

    A ray's factor is eq. 3 with the depth variable summed out: the density of the measurement at the first
    occupied voxel, or beyond, plus the outlier floor. With ``pass_through`` that is the first one in which
    the ray, by chance, stops.
    """
    voxels = sorted({s.voxel for ray in rays for s in ray.segments})
    column = {v: i for i, v in enumerate(voxels)}
    states = (np.arange(2 ** len(voxels))[:, None] >> np.arange(len(voxels))) & 1
    weight = np.where(states == 1, prior, 1 - prior).prod(axis=1)
    for ray in rays:
        factor = np.full(len(states), ray.beyond)
        # From the far end, so that the nearest occupied voxel has the last word.
        for segment, density in zip(reversed(ray.segments), reversed(ray.densities), strict=True):
            stopped = (1 - pass_through) * density + pass_through * factor
            factor = np.where(states[:, column[segment.voxel]] == 1, stopped, factor)
        weight = weight * (factor + floor)
    return {v: float((weight * states[:, i]).sum() / weight.sum()) for v, i in column.items()}
