"""The inference of taichi_mrf in float64 NumPy, ray by ray and voxel by voxel, to compare kernels with.

Written for clarity and from the equations, not from the kernels: it shares no code with them but the
definition of parameters.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from oracles.forward import Noise
from oracles.traversal import segments
from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.sensor.camera import PinholeCamera

Voxel = tuple[int, int, int]


@dataclass(frozen=True)
class Segment:
    """What a ray spends in one voxel, in voxel sizes."""

    voxel: Voxel
    length: float
    share: float = 1.0  # for how many rays it stands


@dataclass(frozen=True)
class Ray:
    """A ray with its measurement. ``beyond`` is the density of the measurement if the first surface lies
    past the last segment. Voxels that are not in ``told`` get no message, if it is given. ``sampled`` rays
    are those of the first sweep; in later ones ``thinned`` takes the place of a ray, if it is given."""

    segments: list[Segment]
    densities: list[float]
    beyond: float
    told: frozenset[Voxel] | None = None
    sampled: bool = True
    thinned: "Ray | None" = None


def cast(
    depth_m: NDArray[np.float32],
    T: NDArray[np.float64],
    camera: PinholeCamera,
    voxel_size: float,
    noise: Noise,
    config: InferenceConfig,
    max_depth: float,
    clear_voxels: float = 0.0,
) -> list[Ray]:
    """All rays of a depth image, with the likelihood of each segment. With strides all are followed from
    ``clear_voxels`` and ``end_sigmas`` before their measurements on."""
    rays = []
    sample, scouts = config.first_sweep_stride, config.free_space_stride
    directions = camera.rays()
    for v, u in np.argwhere(depth_m > 0):
        measured = float(depth_m[v, u])
        direction = T[:3, :3] @ directions[v, u]
        last = float(noise.depth_of_deviation(measured, -config.end_sigmas))
        end = min(last, max_depth)
        cells, near, far = segments(T[:3, 3], direction, 0.0, end, voxel_size)
        lengths = (far - near) * np.linalg.norm(direction) / voxel_size
        centre = 0.5 * (near + far)
        averaged = noise.sigma_at(centre) < voxel_size
        if config.likelihood != "auto":
            averaged = np.full(len(cells), config.likelihood == "segment")
        density = np.where(
            averaged, noise.density_over(measured, near, far), noise.density_at(measured, centre)
        )
        beyond = 0.0
        if end < last:
            likeliest = max(end, float(noise.depth_of_deviation(measured, 0.0)))
            beyond = float(noise.density_at(measured, likeliest))
        voxels = [(int(i), int(j), int(k)) for i, j, k in cells]
        whole = [Segment(*each) for each in zip(voxels, lengths.tolist(), strict=True)]
        thinned = None
        if scouts > 1:
            clear = float(noise.depth_of_deviation(measured, config.end_sigmas))
            clear -= clear_voxels * voxel_size / float(np.linalg.norm(direction))
            if (u + math.isqrt(scouts) * v) % scouts == 0:
                shares = np.where(far <= clear, scouts, 1).tolist()
                kept = [replace(each, share=s) for each, s in zip(whole, shares, strict=True)]
                thinned = Ray(kept, density.tolist(), beyond)
            else:
                left = np.clip((far - clear) / (far - near), 0, 1).tolist()
                parts = [replace(each, length=each.length * p) for each, p in zip(whole, left, strict=True)]
                near_end = [(s, d) for s, d in zip(parts, density.tolist(), strict=True) if s.length > 0]
                thinned = Ray([s for s, _ in near_end], [d for _, d in near_end], beyond)
        sampled = (u + math.isqrt(sample) * v) % sample == 0
        rays.append(Ray(whole, density.tolist(), beyond, None, sampled, thinned))
    return rays


def logit(p: float) -> float:
    return math.log(p / (1 - p))


def logistic(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x > -700 else 0.0


def ray_messages(
    ray: Ray, incoming: dict[Voxel, float], config: InferenceConfig
) -> list[tuple[Voxel, float, float]]:
    """Eqs. 11, 13 and 14 for one ray: (voxel, weight, probability of occupied) for each segment.

    ``incoming`` are log-odds of the voxels as the ray sees them; voxels that it does not hold do not
    exist, and the ray passes through them.
    """
    steps = []
    visibility, explained = 1.0, 0.0
    for segment, density in zip(ray.segments, ray.densities, strict=True):
        if segment.voxel not in incoming:
            continue
        m = (1 - (config.pass_through or 0.0)) * logistic(incoming[segment.voxel])
        length = segment.length if config.segment_lengths else 1.0
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
        weight = segment.share * (segment.length if config.segment_lengths else 1.0)
        out.append((segment.voxel, weight, occupied / (occupied + empty)))
        behind += (1 - free) * here
    return out


def best_messages(
    ray: Ray, incoming: dict[Voxel, float], config: InferenceConfig
) -> list[tuple[Voxel, float, float]]:
    """As :func:`ray_messages`, by the likeliest explanation for either state instead of their sum."""
    steps = [
        (segment, density)
        for segment, density in zip(ray.segments, ray.densities, strict=True)
        if segment.voxel in incoming
    ]
    floor = config.floor + 1e-30
    costs = [-math.log(density + floor) for _, density in steps] + [-math.log(ray.beyond + floor)]
    free, occupied = [], []
    for segment, _ in steps:
        length = segment.length if config.segment_lengths else 1.0
        log_free = -length * math.log1p(math.exp(incoming[segment.voxel]))
        free.append(-log_free)
        occupied.append(-math.log(-math.expm1(log_free)))
    out = []
    for i, (segment, _) in enumerate(steps):
        least = {}
        for state in (0, 1):
            best = math.inf
            for first in range(len(steps) + 1):
                if (first > i and state == 1) or (first == i and state == 0):
                    continue
                total = costs[first]
                for j in range(len(steps)):
                    if j == i:
                        continue
                    if j < first:
                        total += free[j]
                    elif j == first:
                        total += occupied[j]
                    else:
                        total += min(free[j], occupied[j])
                best = min(best, total)
            least[state] = best
        weight = segment.share * (segment.length if config.segment_lengths else 1.0)
        out.append((segment.voxel, weight, logistic(least[0] - least[1])))
    return out


def infer(
    keyframes: list[list[Ray]],
    voxels: set[Voxel],
    prior: float,
    config: InferenceConfig,
) -> dict[Voxel, float]:
    """Gauss-Seidel sweeps over keyframes with average messages; returns each voxel's log-odds."""
    belief = dict.fromkeys(voxels, logit(prior))
    clamp = config.cavity_clamp
    lowest = max(-clamp, logit(config.free_share * prior)) if config.free_share > 0 else -clamp
    sent: list[dict[Voxel, float]] = [{} for _ in keyframes]
    messages_of = best_messages if config.method == "max-product" else ray_messages
    for sweep in range(config.sweeps):
        for listed, messages in zip(keyframes, sent, strict=True):
            rays = [ray.thinned or ray for ray in listed]
            if sweep == 0 and config.first_sweep_stride > 1:
                rays = [ray for ray in listed if ray.sampled]
            seen = {s.voxel for ray in rays for s in ray.segments if s.voxel in belief}
            incoming = {v: min(clamp, max(lowest, belief[v] - messages.get(v, 0.0))) for v in seen}
            weights: dict[Voxel, float] = dict.fromkeys(seen, 0.0)
            sums: dict[Voxel, float] = dict.fromkeys(seen, 0.0)
            for ray in rays:
                for voxel, weight, q in messages_of(ray, incoming, config):
                    if ray.told is not None and voxel not in ray.told:
                        continue
                    if config.average == "log_odds":
                        q = min(1 - 1e-16, max(1e-300, q))
                        q = min(config.message_clamp, max(-config.message_clamp, logit(q)))
                    weights[voxel] += weight
                    sums[voxel] += weight * q
            for voxel in seen:
                if weights[voxel] <= config.min_length:
                    continue
                mean = sums[voxel] / weights[voxel]
                if config.average == "probability":
                    least = logistic(-config.message_clamp)
                    mean = logit(min(1 - least, max(least, mean)))
                rays_here = max(1.0, weights[voxel])
                mean *= rays_here / (1 + config.ray_correlation * (rays_here - 1))
                mean = min(config.message_clamp, max(-config.message_clamp, mean))
                old = messages.get(voxel, 0.0)
                messages[voxel] = old + (1 - config.damping) * (mean - old)
                belief[voxel] += messages[voxel] - old
    return belief


def enumerate_marginals(
    rays: list[Ray], prior: float, floor: float, maximise: bool = False, pass_through: float = 0.0
) -> dict[Voxel, float]:
    """Eq. 1 summed over every assignment of the voxels: exact marginals of occupied.

    With ``maximise`` of the likeliest assignment of either state, as odds. A ray's factor is eq. 3 with the
    depth variable summed out: the density of the measurement at the first occupied voxel, or beyond, plus
    the outlier floor. With ``pass_through`` that is the first one in which the ray, by chance, stops.
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
    if maximise:
        best = {
            v: (weight[states[:, i] == 0].max(), weight[states[:, i] == 1].max()) for v, i in column.items()
        }
        return {v: float(occupied / (free + occupied)) for v, (free, occupied) in best.items()}
    return {v: float((weight * states[:, i]).sum() / weight.sum()) for v, i in column.items()}
