"""A picture of two frames on top of each other, as recorded and without the mistakes."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.doctor.diagnosis import Diagnosis
from taichi_mrf.doctor.mistakes import Mistakes
from taichi_mrf.doctor.search import Search, seen_by, undone
from taichi_mrf.doctor.views import thinned
from taichi_mrf.sensor.camera import PinholeCamera

_POINTS = 60_000
_WIDEST = 640
_GAP = 8
_AGREES = 0.05
_GREEN, _RED, _BLUE = (60, 200, 80), (230, 60, 50), (60, 110, 240)


def overlap(diagnosis: Diagnosis) -> NDArray[np.uint8] | None:
    """RGB (H, W, 3): a frame's depth in grey, and on it the points of another one, as recorded on the left
    and without the mistakes on the right. Points that agree are green; red ones lie in front of what the frame
    saw, blue ones behind. None if no two frames see the same."""
    search = diagnosis.search
    if search is None:
        return None
    before, after = search.differences(Mistakes()), search.differences(diagnosis.mistakes)
    # The pair that shows it best: explained now, and least so before.
    usable = search.usable() & ~np.isnan(after)
    pair = int(np.argmax(np.where(usable, before - 2 * after, -np.inf)))
    panels = [_panel(search, pair, mistakes) for mistakes in (Mistakes(), diagnosis.mistakes)]
    between = np.full((len(panels[0]), _GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([panels[0], between, panels[1]], axis=1)


def _panel(search: Search, pair: int, mistakes: Mistakes) -> NDArray[np.uint8]:
    first, second = (search.sample.views[frame] for frame in search.sample.pairs[pair])
    if isinstance(first.camera, PinholeCamera):
        first = thinned(first.camera, first.image, _POINTS)
    T = search.between(pair, mistakes)
    image = second.image
    most = float(np.percentile(image[image > 0], 98))
    grey = np.where(image > 0, 40 + 160 * np.minimum(image / most, 1), 0).astype(np.uint8)
    panel = np.repeat(grey[..., None], 3, axis=2)
    if T is not None:
        seen = seen_by(undone(first, mistakes), T, second, mistakes)
        off = (seen.expected - seen.measured) / np.maximum(seen.expected, seen.measured)
        for color, chosen in (
            (_BLUE, off > _AGREES),
            (_RED, off < -_AGREES),
            (_GREEN, np.abs(off) <= _AGREES),
        ):
            there = chosen & (seen.measured > 0)
            panel[seen.row[there], seen.column[there]] = color
    step = -(-panel.shape[1] // _WIDEST)
    return panel[::step, ::step]
