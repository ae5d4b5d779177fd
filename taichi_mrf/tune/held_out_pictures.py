"""Pictures of the held-out views for the page: where a map is right, kept for every try, so that any two can
be compared, and how measurements scatter around the expected depth."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.accuracy import NOT_JUDGED, RIGHT, JudgedView
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.unrolled import unrolled
from taichi_mrf.session.pictures import ACCURACY_COLORS, IMAGE_WIDTH, depth_colors
from taichi_mrf.tune.history import History
from taichi_mrf.viewer.tune.messages import HeldOutView, Residuals

BETTER, WORSE, SAME = (0, 114, 178), (213, 94, 0), (225, 225, 225)
"""Colours of a pixel that is right only now, that was right only before, and of any other."""

_MOST_TRIES = 500
"""The pictures of this many tries are kept, besides those of the pinned one."""

MOST_POINTS = 1500
BINS = 12
FEWEST_IN_A_BIN = 20

FURTHEST_SPREADS = 8.0
"""Residuals larger than this many times the middle bin's spread are outliers, and not drawn."""


class HeldOutPictures:
    """The accuracy images of the held-out views by try: losslessly compressed, a few kilobytes each."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self._verdicts: dict[int, list[tuple[bytes, float, float]]] = {}

    def keep(self, number: int, views: Sequence[JudgedView], pixel_stride: int, pinned: int) -> None:
        """Keep the pictures of a try."""
        self._verdicts[number] = [
            _packed(view, frame, pixel_stride) for view, frame in zip(views, self._frames, strict=True)
        ]
        for old in list(self._verdicts):
            if len(self._verdicts) > _MOST_TRIES and old not in (number, pinned):
                del self._verdicts[old]

    def show(self, view: int, number: int, history: History) -> HeldOutView | None:
        """One view of a try, beside that of the reference; None if there is no such view or picture."""
        if not 0 <= view < len(self._frames) or number not in self._verdicts:
            return None
        frame = self._frames[view]
        reference = history.pinned if history.pinned in self._verdicts else None
        shown = self._verdicts[number][view]
        beside = None if reference is None else self._verdicts[reference][view]
        now, then = _verdict(shown[0]), None if beside is None else _verdict(beside[0])
        measured = unrolled(frame.camera).image(frame.depth_m)
        step = _step(measured)
        depths, change_title = [depth_colors(measured[::step, ::step])], ""
        if then is not None and reference != number and then.shape == now.shape:
            better, worse = (now == RIGHT) & (then != RIGHT), (now != RIGHT) & (then == RIGHT)
            change = np.where(better[..., None], BETTER, np.where(worse[..., None], WORSE, SAME))
            depths.insert(0, change.astype(np.uint8))
            change_title = f"From A to B: {better.mean():.1%} became right, {worse.mean():.1%} wrong"
        return HeldOutView(
            name=frame.name,
            accuracy=side_by_side([ACCURACY_COLORS[each] for each in (then, now) if each is not None]),
            title=_title(number, shown),
            reference_title="" if beside is None or reference is None else _title(reference, beside),
            measured=side_by_side(depths),
            change_title=change_title,
        )


def side_by_side(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures (h, w, 3) in a row, each as large as the largest, with white between them."""
    tall, wide = max(picture.shape[:2] for picture in pictures)
    between = np.full((tall, 1 + wide // 40, 3), 255, np.uint8)
    row: list[NDArray[np.uint8]] = []
    for picture in pictures:
        large = cv2.resize(picture, (wide, tall), interpolation=cv2.INTER_NEAREST)
        row += [between, large.astype(np.uint8)]
    return np.concatenate(row[1:], axis=1)


def residuals_of(number: int, views: Sequence[JudgedView]) -> Residuals:
    """Measured minus expected depth at the measured pixels of some views for which the map predicts a depth.

    The map was made of other measurements of the same sensor, so a constant bias that the noise model lacks
    is in both and cancels; one that grows with depth shows where the views are further away.
    """
    depth, residual = np.zeros(0, np.float32), np.zeros(0, np.float32)
    for view in views:
        there = view.measured & view.answered & (view.survey.expected > 0)
        depth = np.concatenate([depth, view.survey.expected[there]])
        residual = np.concatenate([residual, (view.measured_m - view.survey.expected)[there]])
    order = np.argsort(depth, kind="stable")
    depth, residual = depth[order], residual[order]
    # Bins of the same number of pixels, so that each one's spread is known about equally well.
    bins = [b for b in np.array_split(np.arange(len(depth)), BINS) if len(b) >= FEWEST_IN_A_BIN]
    low, middle, high = (
        np.array([np.quantile(residual[each], q) for each in bins]) for q in (0.16, 0.5, 0.84)
    )
    bin_m = np.array([np.median(depth[each]) for each in bins])
    if bins:
        limit = FURTHEST_SPREADS * max(float(np.median(high - low)) / 2, 1e-4)
        near = np.abs(residual - np.median(residual)) <= limit
        depth, residual = depth[near], residual[near]
    some = slice(None, None, -(-len(depth) // MOST_POINTS) or 1)
    return Residuals(
        number=number,
        depth_m=depth[some].copy(),
        residual_m=residual[some].copy(),
        bin_m=bin_m,
        median_m=middle,
        spread_m=(high - low) / 2,
    )


def _packed(view: JudgedView, frame: Frame, pixel_stride: int) -> tuple[bytes, float, float]:
    judged = view.accuracy("1.5sigma")
    picture = unrolled(frame.camera).image(judged.image, NOT_JUDGED)
    step = max(_step(picture), pixel_stride)
    # The picture is of the judged pixels alone.
    first = min(pixel_stride // 2, min(picture.shape) - 1)
    small = np.ascontiguousarray(picture[first::step, first::step])
    return cv2.imencode(".png", small.astype(np.uint8))[1].tobytes(), judged.score, judged.unanswered


def _verdict(packed: bytes) -> NDArray[np.uint8]:
    verdict = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_UNCHANGED)
    assert verdict is not None
    return verdict.astype(np.uint8)


def _title(number: int, shown: tuple[bytes, float, float]) -> str:
    return f"try {number}: {shown[1]:.1%} right within 1.5 voxels, {shown[2]:.1%} without a surface"


def _step(image: NDArray[np.generic]) -> int:
    return -(-image.shape[1] // IMAGE_WIDTH)
