"""What the rays of a sweep (sum_product.py) share: their model, the voxels, and the trace."""

import math
from dataclasses import dataclass

from taichi_mrf.inference.ray_list import RayLattice
from taichi_mrf.kernels.bundles import Bundle
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, I64Array, Template, Vec4Array


@dataclass(frozen=True)
class RayModel(Bundle):
    """What all rays have in common (InferenceConfig)."""

    voxel_size: F32
    """Metres."""

    max_depth: F32
    """Metres of depth that no ray goes beyond."""

    end_sigmas: F32
    """A ray ends this many sigmas behind its measurement."""

    floor: F32
    """Density, per metre, of a measurement that no surface explains."""

    clamp: F32
    """Largest log-odds of a message."""

    pass_through: F32
    """Chance that a ray passes through an occupied voxel."""

    passes: Template
    """Whether that is more than 0."""

    likelihood: Template
    """AUTO, SEGMENT or CENTRE of sensor/forward.py."""

    segment_lengths: Template
    """Whether a voxel counts by the length of the ray's segment in it, or once."""

    log_average: Template
    """Whether rays' log-odds are averaged, or their probabilities."""

    maximise: Template
    """Whether to maximise over explanations instead of summing them."""

    sample: RayLattice
    """The rays that are followed at all,"""

    samples: Template
    """which are not all."""

    scouts: RayLattice
    """Of them those that are followed through free space, where they count for the others,"""

    thins: Template
    """which are not all. The others begin near their measurements:"""

    clear_sigmas: F32
    """so many sigmas,"""

    clear_voxels: F32
    """and so many voxel sizes before them."""


@dataclass(frozen=True)
class SweptVoxels(Bundle):
    """The voxels that a keyframe sees, as its rays read and write them. Arrays (visible bricks * 512)."""

    log_free: F32Array
    """log(1 - m) of the cavity belief, or log(1 - (1 - s) m) (sum_product.py), at most 0."""

    sums: I64Array
    """Lengths and messages summed over rays (accumulators.py)."""

    scale: F32
    """The accumulators' scale."""


@dataclass(frozen=True)
class Trace(Bundle):
    """What rays leave behind on the way out, for the way back: a part of ``longest`` steps for each
    worker."""

    voxel: I32Array
    """(workers * longest): the voxel of each step."""

    step: Vec4Array
    """(workers * longest): length, 1 - m to its power, nu * vis, before; max_product.see_best has its own."""

    longest: I32
    """No ray crosses more voxels than this."""

    steps: I32Array
    """(workers): receives the number of voxels that each worker's rays have crossed."""


def log_pass(pass_through: float) -> float:
    """The logarithm of ``RayModel.pass_through``; of 0, which kernels leave out, 0."""
    return math.log(pass_through) if pass_through > 0 else 0.0
