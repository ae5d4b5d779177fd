"""Renders rectified pairs whose disparity is known exactly, for the tests of stereo."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Layer:
    """A textured plane, seen in the left image within a box; its disparity is a + b u + c v pixels."""

    disparity: tuple[float, float, float]
    box: tuple[int, int, int, int] | None = None
    """First and last + 1 column, first and last + 1 row in the left image; None is everywhere."""

    grey: int | None = None
    """One grey value in place of texture."""


@dataclass(frozen=True)
class Pair:
    """A rendered pair, (H, W) uint8; disparity of the left image, (H, W) pixels; which pixels the right
    camera sees, (H, W)."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    disparity: NDArray[np.float64]
    visible: NDArray[np.bool_]


def render(layers: list[Layer], shape: tuple[int, int] = (120, 300), seed: int = 0) -> Pair:
    """Paint layers from far to near into both images; each must be nearer than the ones before it."""
    random = np.random.default_rng(seed)
    v, u = np.indices(shape).astype(np.float64)
    left, right, disparity = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    left_layer, right_layer = np.full(shape, -1), np.full(shape, -1)
    for index, layer in enumerate(layers):
        a, b, c = layer.disparity
        texture = _texture(random, shape) if layer.grey is None else None
        for image, owner, left_u in ((left, left_layer, u), (right, right_layer, (u + a + c * v) / (1 - b))):
            inside = _inside(layer.box, left_u, v)
            seen = np.full(shape, layer.grey or 0.0) if texture is None else _sample(texture, left_u, v)
            image[inside], owner[inside] = seen[inside], index
        own = left_layer == index
        disparity[own] = (a + b * u + c * v)[own]
    partner = np.rint(u - disparity).astype(int)
    rows = v.astype(int)
    visible = (partner >= 0) & (right_layer[rows, np.maximum(partner, 0)] == left_layer)
    return Pair(_grey(left), _grey(right), disparity, visible)


def _inside(box: tuple[int, int, int, int] | None, u: NDArray, v: NDArray) -> NDArray[np.bool_]:
    if box is None:
        return np.ones(u.shape, bool)
    return (u >= box[0] - 0.5) & (u < box[1] - 0.5) & (v >= box[2]) & (v < box[3])


def _texture(random: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Noise that is smooth enough to be sampled between its pixels, with columns to spare on the right."""
    noise = random.normal(size=(shape[0], 2 * shape[1])).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return 128 + 45 * smooth / smooth.std()


def _sample(texture: NDArray[np.float32], u: NDArray, v: NDArray) -> NDArray[np.float32]:
    return cv2.remap(
        texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT
    )


def _grey(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
