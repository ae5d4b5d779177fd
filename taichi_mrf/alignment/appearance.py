"""Likeness of keyframes to an image: small, coarse pictures of inverse depth and of brightness, compared by
their correlation. It tells views from about the same place in about the same direction, and nothing more
exact: an alignment has to follow."""

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 32, 24
"""Of the small pictures, in pixels."""

BLUR = 1.5
"""Standard deviation, in pixels of those, of what they are blurred with: views a few degrees apart are to
look alike."""

LEAST_SEEN = 0.2
"""Share of a picture that must hold depth."""

Picture = NDArray[np.float32]
"""(2, HEIGHT * WIDTH): inverse depth and brightness, each of mean 0 and length 1, or 0 if there is none."""


def small_picture(depth_m: NDArray[np.float32], color: NDArray[np.uint8] | None) -> Picture:
    """The small picture of a depth image (H, W) in metres and its colours (H, W, 3) RGB, if it has any."""
    measured = np.isfinite(depth_m) & (depth_m > 0)
    nearness = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=measured)
    gray = np.zeros_like(depth_m)
    if color is not None:
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.stack([_normalised(nearness, measured), _normalised(gray, gray > 0)])


def _normalised(image: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    size = (WIDTH, HEIGHT)
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if share.mean() < LEAST_SEEN:
        return np.zeros(WIDTH * HEIGHT, np.float32)
    total = cv2.resize(np.where(known, image, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    share, total = cv2.GaussianBlur(share, (0, 0), BLUR), cv2.GaussianBlur(total, (0, 0), BLUR)
    small = total / np.maximum(share, 1e-3)
    small = np.where(share > LEAST_SEEN, small - small[share > LEAST_SEEN].mean(), 0.0).ravel()
    length = np.linalg.norm(small)
    return np.asarray(small / length if length > 1e-6 else np.zeros_like(small), np.float32)


class Appearances:
    """The small pictures of keyframes, by id."""

    def __init__(self) -> None:
        self._pictures: dict[int, Picture] = {}

    def add(self, id: int, picture: Picture) -> None:
        """Add a keyframe's picture."""
        self._pictures[id] = picture

    def like(self, id: int) -> dict[int, float]:
        """Likeness of each other keyframe to keyframe ``id``; see :meth:`likeness`."""
        likeness = self.likeness(self._pictures[id])
        del likeness[id]
        return likeness

    def likeness(self, picture: Picture) -> dict[int, float]:
        """Likeness of each keyframe to a picture, -1 to 1: the mean correlation of what both have."""
        if not self._pictures:
            return {}
        pictures = np.stack(list(self._pictures.values()))
        both = (np.abs(pictures).max(axis=2) > 0) & (np.abs(picture).max(axis=1) > 0)
        correlation = np.einsum("ncp,cp->nc", pictures, picture)
        mean = np.where(both, correlation, 0.0).sum(axis=1) / np.maximum(1, both.sum(axis=1))
        return dict(zip(self._pictures, mean.tolist(), strict=True))
