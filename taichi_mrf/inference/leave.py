"""A keyframe leaves: its messages are taken out of the beliefs, or stay in the evidence for good."""

from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import AnyArray, F32Array, I32Array, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import moves
from taichi_mrf.voxels.numbering import strip_begin


@kernel
def withdraw(slots: I32Array, belief: F32Array, messages: AnyArray, moved: I32Array, strip: Template) -> None:
    """Take a keyframe's messages out of the beliefs; arrays as in sum_product.finish."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        count = 0
        for k in range(strip):
            message = ti.cast(messages[i + k], ti.f32)
            count += moves(belief[j + k], -message)
            belief[j + k] -= message
        if count > 0:
            moved[i // VOXELS] += count


@kernel
def fold(slots: I32Array, evidence: F32Array, messages: AnyArray, strip: Template) -> None:
    """Add a keyframe's messages (n * 512) to the ``evidence`` (pool * 512) that inference starts from
    (freezing)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            evidence[j + k] += ti.cast(messages[i + k], ti.f32)
