"""The search for the mistakes with which frames explain each other best."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.overlap import seen_again
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.doctor.mistakes import AXES, LENSES, UNITS, Mistakes
from taichi_mrf.doctor.views import REACH_S, Sample, View
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera

Floats = NDArray[np.float64]

EXPLAINED = 0.04
"""Frames whose depths differ by less, as a share of depth, explain each other."""

_WORST = 0.2
_EXPLAINING = 0.5
_NOISE = 0.002
_AS_WELL = 1.3
_FEWEST_PAIRS = 3
_KEPT = 6
_LATE_STEPS_S = (0.05, 0.01)


class Search:
    """Tries mistakes on the pairs of a sample.

    A pair's difference is the mean of |expected - measured|, as a share of the larger of the two, over the
    half of the first frame's points that fit best; a point that the second frame does not see counts as much
    as one that does not fit at all. So what lies behind something else does no harm, and a view that sees
    nothing wins nothing.
    """

    def __init__(self, sample: Sample, steps_per_metre: float) -> None:
        """``steps_per_metre`` is the unit of the depth images as they were read."""
        self.sample = sample
        self.units = [steps_per_metre / steps for steps in UNITS if not np.isclose(steps, steps_per_metre)]
        self._known: dict[Mistakes, Floats] = {}
        self._least = np.full(len(sample.pairs), _WORST)
        self._place = {int(frame): place for place, frame in enumerate(sample.frames)}
        self._has_pinholes = any(isinstance(view.camera, PinholeCamera) for view in sample.views.values())
        stamps = sample.stamps
        gaps = np.diff(np.sort(stamps))
        self._ordered = len(stamps) > 1 and bool((np.diff(stamps) > 0).all())
        self._gap = 3 * float(np.median(gaps)) if len(gaps) else 0.0

    def differences(self, mistakes: Mistakes) -> Floats:
        """By how much the frames of each pair differ once the mistakes are undone, 0 to 0.2; NaN where a pose
        is not known at the time."""
        if mistakes not in self._known:
            found = np.fromiter(self._differences(mistakes), np.float64)
            self._known[mistakes], self._least = found, np.fmin(self._least, found)
        return self._known[mistakes]

    def _differences(self, mistakes: Mistakes) -> Iterable[float]:
        sample = self.sample
        poses, known = mistakes.poses(sample.poses), np.ones(len(sample.poses), dtype=bool)
        if mistakes.late_s:
            timed = TimedPoses(sample.stamps, poses)
            poses, known = timed.between(sample.stamps + mistakes.late_s, self._gap)
        points = {frame: undone(view, mistakes) for frame, view in sample.views.items()}
        for first, second in sample.pairs:
            a, b = self._place[first], self._place[second]
            if not (known[a] and known[b]):
                yield float("nan")
            else:
                T = inverse(poses[b]) @ poses[a]
                there = _difference(points[first], T, sample.views[second], mistakes)
                back = _difference(points[second], inverse(T), sample.views[first], mistakes)
                yield min(there, back)

    def usable(self) -> NDArray[np.bool_]:
        """The pairs that something that was tried explains: the others see different things."""
        return self._least <= EXPLAINED

    def score(self, mistakes: Mistakes) -> float:
        """The mean difference over the usable pairs; infinite if too few of them tell."""
        found = self.differences(mistakes)
        usable = self.usable()
        told = usable & ~np.isnan(found)
        if told.sum() < max(_FEWEST_PAIRS, usable.sum() / 3):
            return float("inf")
        whole = self.differences(replace(mistakes, late_s=0.0))
        # Of late poses some pairs are not known. What they lack is made up for, so that scores compare.
        return float(found[told].mean() * (whole[usable].mean() + _NOISE) / (whole[told].mean() + _NOISE))

    def clearly_better(self, one: Mistakes, other: Mistakes) -> bool:
        """Whether frames explain each other with the one, and differ by more than twice as much with the other."""
        return self.score(one) <= EXPLAINED and 2 * (self.score(one) + _NOISE) < self.score(other) + _NOISE

    def best(self) -> Mistakes:
        """The fewest mistakes that explain the frames; none unless they do so clearly better."""
        none = Mistakes()
        kept = self._best([none], self.of_poses_and_unit)
        kept = self._best(kept, self.of_camera)
        if self.score(kept[0]) > _NOISE:  # two mistakes at once: the first was sought in the presence of the other
            kept = self._best(kept[: _KEPT // 2], self.of_poses_and_unit)
            kept = self._best(kept[: _KEPT // 2], self.of_camera)
        if self._ordered:
            for step in _LATE_STEPS_S:
                kept = self._best(kept[: _KEPT // 2], partial(self.of_time, step=step))
        best = self._simpler(kept[0])
        return best if best != none and self.clearly_better(best, none) else none

    def undecided(self, best: Mistakes) -> list[str]:
        """What other frames would have to show: assumptions whose contrary explains these as well as the best."""
        others = {
            "the direction of the poses": [replace(best, inverse=not best.inverse)],
            "the order of quaternions": [replace(best, w_first=not best.w_first)],
            "the axes of the camera frame": [replace(best, axes=axes) for axes in AXES if axes != best.axes],
            "the unit of depth": [replace(best, factor=best.factor * times) for times in (0.2, 5.0, 1000.0)],
            "the time of the poses": [replace(best, late_s=best.late_s + late) for late in (-0.3, 0.3)],
        }
        if self._has_pinholes:
            others["depth along the ray or the axis"] = [replace(best, along_ray=not best.along_ray)]
            others["the size of images that intrinsics are of"] = [
                replace(best, lens=lens) for lens in [*LENSES][:2] if lens != best.lens
            ]
        for each in (other for several in others.values() for other in several):
            self.differences(each)
        limit = _AS_WELL * (self.score(best) + _NOISE) - _NOISE
        found = [name for name, tried in others.items() if min(map(self.score, tried)) < limit]
        timeless = not any(np.isfinite(self.score(late)) for late in others["the time of the poses"])
        return [*found, "the time of the poses"] if timeless else found

    def _best(self, kept: Sequence[Mistakes], options: Callable[[Mistakes], list[Mistakes]]) -> list[Mistakes]:
        """The best of what an option makes of those kept, and these themselves."""
        tried = dict.fromkeys(each for mistakes in kept for each in [mistakes, *options(mistakes)])
        for mistakes in tried:
            self.differences(mistakes)
        ranked = sorted(tried, key=self.score)[:_KEPT]
        none = Mistakes()
        return ranked if none in ranked else [*ranked, none]

    def _simpler(self, mistakes: Mistakes) -> Mistakes:
        """The same without the mistakes that it does as well without."""
        for field in fields(Mistakes):
            without = replace(mistakes, **{field.name: field.default})
            if without != mistakes and not self.clearly_better(mistakes, without):
                mistakes = without
        return mistakes

    def of_poses_and_unit(self, m: Mistakes) -> list[Mistakes]:
        """Every way in which poses can be written, with every unit."""
        ways = product((False, True), (False, True), AXES, (1.0, *self.units))
        return [replace(m, inverse=i, w_first=w, axes=a, factor=f) for i, w, a, f in ways]

    def of_camera(self, m: Mistakes) -> list[Mistakes]:
        """Depth along the ray, and other intrinsics; nothing for what is no pinhole."""
        if not self._has_pinholes:
            return []
        return [replace(m, along_ray=ray, lens=lens) for ray in (False, True) for lens in ("", *LENSES)]

    def of_time(self, m: Mistakes, step: float) -> list[Mistakes]:
        """Poses that are late or early: by anything at the first step, else by something near."""
        count = round((REACH_S if step == _LATE_STEPS_S[0] else _LATE_STEPS_S[0]) / step)
        return [replace(m, late_s=round(m.late_s + i * step, 4)) for i in range(-count, count + 1)]


def undone(view: View, mistakes: Mistakes) -> Floats:
    """The points (N, 3) of a view without the mistakes."""
    camera = view.camera
    if not isinstance(camera, PinholeCamera):
        return view.points * mistakes.factor
    rays = mistakes.camera(camera).directions(view.u, view.v)
    if mistakes.along_ray:
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays * (view.points[:, 2:] * mistakes.factor)


def seen_by(
    points: Floats, T_second_first: Pose, view: View, mistakes: Mistakes
) -> tuple[Floats, Floats]:
    """Points (N, 3) of another view in this one: their expected and their measured depths (N,), as
    overlap.seen_again has them."""
    camera = view.camera
    if isinstance(camera, PinholeCamera):
        camera = mistakes.camera(camera)
    expected, measured = seen_again(points, T_second_first, view.image, camera)
    if mistakes.along_ray and isinstance(camera, PinholeCamera):
        expected = np.linalg.norm(points @ T_second_first[:3, :3].T + T_second_first[:3, 3], axis=1)
    return expected, measured * mistakes.factor


def _difference(points: Floats, T_second_first: Pose, view: View, mistakes: Mistakes) -> float:
    expected, measured = seen_by(points, T_second_first, view, mistakes)
    off = np.full(len(points), _WORST)
    both = measured > 0
    share = np.abs(expected[both] - measured[both]) / np.maximum(expected[both], measured[both])
    off[both] = np.minimum(share, _WORST)
    count = max(1, int(_EXPLAINING * len(off)))
    return float(np.partition(off, count - 1)[:count].mean())
