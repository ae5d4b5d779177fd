"""The least that each kernel of a new keyframe must read and write, in bytes, from what there is to do.

Divided by the memory's bandwidth it is a floor under the kernel's time: nothing that computes the same can be
faster, unless its data are still in a cache. Every array is counted once, however often it is touched.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from taichi_mrf.inference.sweep import TRACE_BYTES
from taichi_mrf.voxels.layout import VOXELS

Floor = Callable[["Work"], float]


@dataclass(frozen=True)
class Work:
    """Work of a keyframe for its kernels.

    ``crossed``, ``surface``, ``created`` and ``visible`` are bricks (see inference/keyframe.py); ``met`` are
    the voxels that get a message, ``voxel_steps`` those crossed, each ray's counted. ``message_bytes`` are
    those of one message. ``trace_in_cache``: whether a ray's steps never reach the memory.
    """

    pixels: float
    rays: float
    crossed: float
    surface: float
    created: float
    visible: float
    met: float
    voxel_steps: float
    message_bytes: float
    trace_in_cache: bool

    @property
    def voxels(self) -> float:
        """Voxels of the visible bricks."""
        return self.visible * VOXELS

    @property
    def trace_bytes(self) -> float:
        """Bytes of the trace, written once and read once."""
        return 0.0 if self.trace_in_cache else 2 * TRACE_BYTES * self.voxel_steps


FLOORS: Mapping[str, Mapping[str, Floor]] = {
    "allocate": {
        "ext_arr_to_ndarray": lambda w: 8 * w.pixels,  # the depth image, to the device
        "_choose": lambda w: 20 * w.pixels,  # depth in; nearest, farthest, mean, level out
        "_write_down": lambda w: 4 * w.pixels + 12 * w.rays,  # levels and means in, the list out
        "_mark": lambda w: 8 * w.rays + 4 * w.crossed,  # the list in, marks out
        "read": lambda w: 20 * (w.surface + w.crossed),  # coordinates and the tree in, slots out
        "fill_bricks": lambda w: (4 + 4 * VOXELS) * w.created,
        "write": lambda w: 20 * w.created,  # coordinates and slots in, the tree out
        "count": lambda w: 20 * w.crossed,  # coordinates in, the tree in and out
    },
    "own_sweep": {
        "_clear": lambda w: w.message_bytes * w.voxels,  # new messages
        "cavity": lambda w: (
            (4 + w.message_bytes + 4 + 8) * w.voxels
        ),  # belief, message in; log_free, sums out
        "_enter": lambda w: 12 * w.visible,  # cells and their order in, index out
        "_take_out": lambda w: 8 * w.visible,  # cells in, index out
        "send_messages": lambda w: 12 * w.rays + (4 + 8 + 8) * w.met + w.trace_bytes,
        "finish": lambda w: 8 * w.voxels + (2 * w.message_bytes + 8) * w.met,
        "ndarray_to_ext_arr": lambda w: 8 * w.visible,  # how many moved
    },
}
"""By stage and by the kernel's name."""

COPIES = ("ext_arr_to_ndarray", "ndarray_to_ext_arr")
"""Those that bring arrays to the device and back: there are none on a CPU (kernels/resident.py)."""
