"""Common parts of the rays of a sweep (sum_product.py): their model, the voxels, and the trace."""

import math
from dataclasses import dataclass
from typing import Literal

from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, I64Array, Template, Vec4Array

END_SIGMAS = 3.0
"""A ray ends this many sigma behind its measurement, and bricks are allocated this many sigma around it."""


@dataclass(frozen=True)
class Limits:
    """Bounds that keep a few measurements from overruling all others, and what else all maps share."""

    message: float = 6.9
    """Bound on the log-odds of a keyframe's message to a voxel: a probability of 0.999."""

    cavity: float = 9.2
    """Bound on the log-odds of a voxel's belief minus the keyframe's own message."""

    length: float = 0.02
    """A voxel keeps its old message if a keyframe's rays cross it for less than this length in total, in
    voxel sizes."""

    segment_lengths: bool = True
    """See RayModel."""

    precision: Literal["float16", "float32"] = "float16"
    """Storage of messages. float16 halves their memory and changes beliefs by at most 0.006."""


AS_PRINTED = Limits(message=25.0, cavity=25.0, length=0.0, segment_lengths=False, precision="float32")
"""Next to no bounds, and no lengths: the equations as the paper prints them, for comparisons with exact
inference."""


@dataclass(frozen=True)
class RayModel(Bundle):
    """Model of all rays (InferenceConfig)."""

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
    """True if ``pass_through`` is more than 0."""

    segment_lengths: Template
    """True if a voxel counts by the length of the ray's segment in it (section IV-A); False if it counts
    once, as eqs. 11 to 14 are printed."""


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
    """Record of rays on the way out, for the way back: steps of the longest ray for each worker."""

    voxel: I32Array
    """(workers * steps): the voxel of each step."""

    step: Vec4Array
    """(workers * steps): length, 1 - m to its power, nu * vis, before."""

    worker_stride: I32
    step_stride: I32
    """From a worker's step to the next worker's, and to its own next one."""

    steps: I32Array
    """(workers): receives the number of voxels that each worker's rays have crossed."""

    @ti.func
    def place(self, worker: I32, step: I32):
        """Place of a worker's step."""
        return worker * self.worker_stride + step * self.step_stride


def log_pass(pass_through: float) -> float:
    """The logarithm of ``RayModel.pass_through``; of 0, which kernels leave out, 0."""
    return math.log(pass_through) if pass_through > 0 else 0.0
