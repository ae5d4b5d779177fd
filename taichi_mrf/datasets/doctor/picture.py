"""A picture of two frames on top of each other: as they were read, and as they explain each other."""

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.doctor.diagnosis import Diagnosis
from taichi_mrf.datasets.doctor.readings import Reading
from taichi_mrf.datasets.doctor.search import Search, points_of, seen_by
from taichi_mrf.datasets.doctor.views import thinned
from taichi_mrf.sensor.camera import PinholeCamera

_POINTS = 200_000
_NARROWEST, _WIDEST = 480, 640
_GAP = 8
_AGREES = 0.05
_GREEN, _RED, _BLUE = (60, 200, 80), (230, 60, 50), (60, 110, 240)


def overlap(diagnosis: Diagnosis) -> NDArray[np.uint8] | None:
    """RGB (H, W, 3): a frame's depth in grey, and on it the points of another one, as they were read on the
    left and by the best reading on the right. Points that agree are green; red ones lie in front of what the
    frame saw, blue ones behind it. None if no two frames see the same."""
    search = diagnosis.search
    if search is None:
        return None
    before, after = search.differences(search.given), search.differences(diagnosis.reading)
    # The pair that shows it best: explained now, and least so before.
    shown = np.where(search.usable() & ~np.isnan(after), np.nan_to_num(before) - 2 * after, -np.inf)
    pair = int(np.argmax(shown))
    left = _labelled(_panel(search, pair, search.given), "as read")
    right = _labelled(_panel(search, pair, diagnosis.reading), "mended")
    between = np.full((len(left), _GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([left, between, right], axis=1)


def _labelled(panel: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The panel, large enough to be looked at, with a label in its corner."""
    times = max(1, _NARROWEST // panel.shape[1])
    large = np.ascontiguousarray(panel.repeat(times, axis=0).repeat(times, axis=1))
    for color, width in ((0, 4), (255, 1)):  # white with a black edge reads on any ground
        cv2.putText(large, text, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (color,) * 3, width, cv2.LINE_AA)
    return large


def _panel(search: Search, pair: int, reading: Reading) -> NDArray[np.uint8]:
    first, second = (search.sample.views[frame] for frame in search.sample.pairs[pair])
    if isinstance(first.camera, PinholeCamera):
        first = thinned(first.camera, first.image, _POINTS)
    image = second.image
    far = float(np.percentile(image[image > 0], 98))
    grey = np.where(image > 0, 40 + 160 * np.minimum(image / far, 1), 0).astype(np.uint8)
    panel = np.repeat(grey[..., None], 3, axis=2)
    T = [*search.moves(reading)][pair]
    step = -(-panel.shape[1] // _WIDEST)
    if T is not None:
        seen = seen_by(second, points_of(first, reading), T, reading)
        there = seen.measured > 0
        expected, measured = seen.expected[there], seen.measured[there]
        off = (expected - measured) / np.maximum(expected, measured)
        colors = np.where((np.abs(off) <= _AGREES)[:, None], _GREEN, np.where(off[:, None] > 0, _BLUE, _RED))
        panel[seen.rows[there] // step * step, seen.columns[there] // step * step] = colors
    return panel[::step, ::step]
