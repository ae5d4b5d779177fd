"""A layer of voxels that the package does not have: a histogram of eight classes, of an image beside depth.

It is all that a new layer needs: an entry for the table (``ENTRY``), a visitor, and colours for the page.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.accumulators import low_half
from taichi_mrf.inference.pixel_pass import PixelVisitor, add_pair
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import on_host
from taichi_mrf.system.types import F32, I32, Template
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import FromPixels, Layer, OnPage

CLASSES = 8
PALETTE = np.array([[30 * n, 255 - 30 * n, 40] for n in range(1, CLASSES + 1)], np.uint8)
STEPS = 8.0
"""Steps of a class's sum for each pixel."""

LABELS = "kinds"
PAGE = OnPage(
    "what it is", "which class a voxel has.", "the likeliest class", "label_layer:painted",
    tuple((f"class {n}", tuple(PALETTE[n - 1].tolist())) for n in range(1, CLASSES + 1)),
)  # fmt: skip
ENTRY = Layer(
    "uint16", CLASSES, 0, "eighths of pixels of each class",
    FromPixels(LABELS, 1, "label_layer:LabelVisitor", "frozen_labels", ("c01", "c23", "c45", "c67"), PAGE),
)  # fmt: skip

Counts = ti.types.vector(CLASSES, ti.f32)


def painted(values: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The colours of the likeliest classes."""
    return np.where(values.any(axis=-1)[..., None], PALETTE[values.argmax(axis=-1)], np.uint8(NO_COLOR))


@dataclass(frozen=True)
class LabelVisitor(PixelVisitor):
    """Counts the labels, 1 to 8, of rays' pixels in the voxels that they see; 0 is none."""

    @staticmethod
    def packed(image: NDArray[np.uint8]) -> NDArray[np.int32]:
        return image.reshape(-1).astype(np.int32)

    @ti.func
    def read(self, block: I32):  # noqa: ANN201
        u, v, wide, high = block_of(block, self.width)
        counts = Counts(0.0)
        for row in range(v, v + high):
            for column in range(u, u + wide):
                label = self.image[row * self.width + column]
                for each in ti.static(range(CLASSES)):
                    if label == each + 1:
                        counts[each] += 1.0
        return counts

    @ti.func
    def give(self, voxel: I32, unit: F32, said: Template):  # noqa: ANN201
        for word in ti.static(range(CLASSES // 2)):
            if said[2 * word] + said[2 * word + 1] > 0.0:
                add_pair(self.sums, 4 * voxel + word, unit * said[2 * word], unit * said[2 * word + 1])

    @ti.func
    def finish(self, voxel: I32):  # noqa: ANN201
        for word in ti.static(range(CLASSES // 2)):
            pair = self.sums[4 * voxel + word]
            high = ti.min(255.0, ti.cast(pair >> 32, ti.f32) / self.scale * STEPS + 0.5)
            low = ti.min(255.0, ti.cast(low_half(pair), ti.f32) / self.scale * STEPS + 0.5)
            self.sums[4 * voxel + word] = (ti.cast(high, ti.i64) << 32) + ti.cast(low, ti.i64)

    @staticmethod
    def values(sums: Any) -> NDArray[np.uint16]:
        pairs = on_host(sums)
        both = np.stack([pairs >> 32, pairs & 0xFFFFFFFF], axis=-1).reshape(-1, CLASSES)
        return np.minimum(both, 0xFFFF).astype(np.uint16)
