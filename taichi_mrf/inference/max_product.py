"""The maximising form of sum_product.py: the message of the best explanation of a measurement to each voxel.

Max-product belief propagation (eq. 20 of Dhiman, Kundu, Dellaert and Corso, ICRA 2014) on the rays of MRFMap.
Where sum-product adds up the probabilities of all ways to explain a measurement, this takes the likeliest of
them, for either state of a voxel. Costs are negative logarithms; a ray's cost depends on its first occupied
voxel alone, and first_occupied.py describes how all its messages are found in one pass there and one back. A
voxel that the ray crosses for the length l is free with probability (1 - m)^l, as it is there.
"""

from taichi_mrf.inference.first_occupied import message, next_ahead, next_behind
from taichi_mrf.kernels.log_odds import log_of_rest, logistic
from taichi_mrf.kernels.types import F32, Template, Vec4
from taichi_mrf.system.compiler import ti


@ti.func
def cost(density: F32, floor: F32) -> F32:
    """Cost of a measurement that has this density, or else is an outlier."""
    return -ti.log(density + floor)


@ti.func
def see_best(ahead: Template, length: F32, log_free: F32, density: F32, floor: F32) -> Vec4:
    """One voxel on the way out: renews ``ahead``, and returns what the way back needs.

    That is the length; what occupied costs more than free, as all others believe; the cost of its being the
    first occupied voxel; and ``ahead`` as it was before it.
    """
    step = Vec4(length, log_free - log_of_rest(log_free), cost(density, floor), ahead)
    ahead = next_ahead(ahead, step[2], step[1], False)
    return step


@ti.func
def best_message(step: Vec4, behind: Template, clamp: F32, log_average: Template) -> F32:
    """One voxel on the way back: renews ``behind``, and returns the ray's message as accumulators take it.

    Clamped log-odds moved from [-clamp, clamp] to [0, 1] with ``log_average``, else a probability.
    """
    log_odds = -message(step[3], step[2], behind, False)
    behind = next_behind(behind, step[2], step[1], False)
    told = logistic(log_odds)
    if ti.static(log_average):
        told = 0.5 + 0.5 * ti.max(-1.0, ti.min(1.0, log_odds / clamp))
    return told
