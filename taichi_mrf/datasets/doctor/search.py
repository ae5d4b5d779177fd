"""The search for the reading of a recording with which its frames explain each other best."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.conventions import AXES, POSE_UNITS, TURNS
from taichi_mrf.datasets.depth_scale import SeenAgain, pixels_of, seen_again
from taichi_mrf.datasets.derived import pose_of
from taichi_mrf.datasets.doctor.readings import LENSES, UNITS, Reading
from taichi_mrf.datasets.doctor.views import REACH_S, Floats, Sample, Sphere, View
from taichi_mrf.datasets.timed_poses import TimedPoses
from taichi_mrf.datasets.turned import T_sensor_stored
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera

EXPLAINED = 0.03
"""Frames whose depths differ by less, as a share of depth, explain each other."""

FEWEST_PAIRS = 3
"""Fewer pairs of frames do not tell a reading from another."""

SEEN_THROUGH = 0.15
"""Share of the points seen again that lie in front of what is measured there, of the middle one of all
pairs, up to which frames need not contradict each other: clean recordings have .05 at most."""

NEARER = 0.95
"""A point at less than this share of the depth that is measured there is looked through."""

QUESTIONS = {
    "inverse": "the direction of poses",
    "w_first": "the order of quaternions",
    "axes": "the axes of the camera",
    "factor": "the unit of depth",
    "along_ray": "depth along the ray or the axis",
    "turned": "how images are turned",
    "lens": "the size of the intrinsics' images",
    "camera": "whether the intrinsics change",
    "focal": "the focal length",
    "late_s": "the time of poses",
}
"""Question that each field of a reading answers."""

_WELL = 0.01
"""Frames of clean recordings of depth cameras differ by .7% at most, those of turned images that are read as
they are by 1.2% or more: some reading explains near pairs by chance."""

_WORST = 0.2
_EXPLAINING = 0.5
_NOISE = 0.002
_BETTER, _AS_WELL = 2.0, 1.3
_SEEN_AGAIN = 0.3
_ROUNDS = 3
_FEW, _MANY = 2, 8
_LATE_STEPS_S = (0.05, 0.01)
_FOCAL_STEPS, _FOCAL_REACH = (0.05, 0.01), 0.3
_FOCAL_OFF, _FOCAL_PAIRS, _FOCAL_AGREE, _FOCAL_BETTER = 0.06, 8, 0.9, 1.5

Options = Callable[[Reading], list[Reading]]


class Search:
    """Tries readings on the pairs of a sample, whose frames were read as ``given``.

    A pair's difference is the mean of |expected - measured|, as a share of the larger of the two, over the
    half of a frame's points that fit best, seen from the one or the other frame, whichever fits better. A
    point that is not seen again counts as one that does not fit at all. So what lies behind something else
    does no harm, nor does what a camera leaves behind as it moves ahead, and a reading with which frames see
    nothing of each other wins nothing.
    """

    def __init__(self, sample: Sample, given: Reading, steps_per_metre: float) -> None:
        """``steps_per_metre`` is the unit of the depth images as they are read."""
        self.sample, self.given = sample, given
        # Poses in another unit are depths that are multiplied (diagnosis.py, _with_likeliest_units).
        of_poses = np.array([1.0, *POSE_UNITS.values()]) / POSE_UNITS.get(given.unit, 1.0)
        self._of_depth = list(dict.fromkeys([1.0, *(steps_per_metre / steps for steps in UNITS)]))
        factors = np.outer(self._of_depth, of_poses).ravel()
        self._units = [float(each) for each in np.unique(factors.round(12)) if not np.isclose(each, 1.0)]
        self._known: dict[Reading, Floats] = {}
        self._mended: dict[Reading, Floats] = {}
        self._measured: dict[Reading, dict[int, Floats]] = {}
        self._usable = 0, np.zeros(len(sample.pairs), dtype=bool)
        self._place = {int(frame): place for place, frame in enumerate(sample.frames)}
        cameras = [view.camera for view in sample.views.values() if isinstance(view.camera, PinholeCamera)]
        of_lenses = {LENSES[lens](camera): lens for camera in cameras[:1] for lens in reversed(LENSES)}
        self._has_pinholes = bool(cameras)
        self._lenses = [lens for camera, lens in of_lenses.items() if camera != cameras[0]]
        self._cameras = dict.fromkeys(cameras) if len({camera.shape for camera in cameras}) == 1 else {}
        gaps = np.diff(sample.stamps)
        self._has_stamps = len(gaps) > 0 and bool((gaps > 0).all())
        self._gap = 3 * float(np.median(gaps)) if len(gaps) else 0.0

    def differences(self, reading: Reading) -> Floats:
        """By how much the frames of each pair differ, 0 to 0.2; NaN where a pose is not known at the time."""
        if reading not in self._known:
            self._known[reading] = self._differences(reading)
        return self._known[reading]

    def moves(self, reading: Reading) -> Iterator[Pose | None]:
        """T_second_first of each pair, None where a pose is not known at the time."""
        of_poses = reading.of_poses_alone
        if of_poses not in self._mended:
            mended = [pose_of(T, of_poses) for T in self.sample.poses]
            self._mended[of_poses] = np.array(mended).reshape(-1, 4, 4)
        poses, known = self._mended[of_poses], np.ones(len(self.sample.poses), dtype=bool)
        if reading.late_s:
            stamps = self.sample.stamps
            poses, known = TimedPoses(stamps, poses).between(stamps + reading.late_s, self._gap)
        turn = T_sensor_stored(reading.turned)
        for first, second in self.sample.pairs:
            a, b = self._place[first], self._place[second]
            T = inverse(poses[b]) @ poses[a] if known[a] and known[b] else None
            yield T if T is None or not reading.turned else turn.T @ T @ turn

    def _differences(self, reading: Reading) -> Floats:
        """Points seen by views of one camera are projected at once: a search tries thousands of readings."""
        views, points = self.sample.views, self._points(reading)
        looks: dict[PinholeCamera | Sphere, list[tuple[int, int, Floats, View]]] = {}
        moves = zip(self.sample.pairs, self.moves(reading), strict=True)
        for index, ((first, second), T) in enumerate(moves):
            if T is None:
                continue
            for way, one, other, move in ((0, first, second, T), (1, second, first, inverse(T))):
                moved = points[one] @ move[:3, :3].T + move[:3, 3]
                looks.setdefault(views[other].camera, []).append((way, index, moved, views[other]))
        found = np.full((2, len(self.sample.pairs)), np.nan)
        for camera, seen in looks.items():
            off = _off(camera, [(moved, view) for _, _, moved, view in seen], reading)
            for (way, index, _, _), each in zip(seen, off, strict=True):
                count = max(1, int(_EXPLAINING * len(each)))
                found[way, index] = np.partition(each, count - 1)[:count].mean()
        return found.min(axis=0)

    def _points(self, reading: Reading) -> dict[int, Floats]:
        """The points (N, 3) of each view in the camera frame."""
        of_camera = reading.of_camera
        if of_camera not in self._measured:
            views = self.sample.views.items()
            self._measured[of_camera] = {frame: points_of(view, of_camera) for frame, view in views}
        return {frame: points * reading.factor for frame, points in self._measured[of_camera].items()}

    def usable(self) -> NDArray[np.bool_]:
        """The pairs that something that was tried explains: the others see different things. Of so many
        readings one explains a pair by chance, so only those that explain many count."""
        if self._usable[0] < len(self._known):
            explained = np.array([*self._known.values()]) <= EXPLAINED
            pairs = explained.sum(axis=1)
            telling = explained[pairs >= max(FEWEST_PAIRS, pairs.max() / 2)]
            self._usable = len(self._known), telling.any(axis=0)
        return self._usable[1]

    def score(self, reading: Reading) -> float:
        """The mean difference over the usable pairs. If too few of them tell, one more than over all."""
        found, usable = self.differences(reading), self.usable()
        told = usable & ~np.isnan(found)
        if told.sum() < max(FEWEST_PAIRS, usable.sum() / 3):
            return 1 + float(np.nan_to_num(found, nan=1.0).mean()) if len(found) else 2.0
        # Of late poses some pairs are not known. What they lack is made up for, so that scores compare.
        whole = self.differences(replace(reading, late_s=0.0)) + _NOISE
        return float(found[told].mean() * whole[usable].mean() / whole[told].mean())

    def seen_through(self, reading: Reading) -> float:
        """The share of the points seen again that the other frame saw through, of the middle one of the pairs
        with enough of them; 0 if they are too few. What frames with little in common never tell from depths
        that differ, this does: nothing hides what lies in front."""
        points, shares = self._points(reading), []
        for (first, second), T in zip(self.sample.pairs, self.moves(reading), strict=True):
            for one, other, move in ((first, second, T), (second, first, None if T is None else inverse(T))):
                if move is None:
                    continue
                seen = seen_by(self.sample.views[other], points[one], move, reading)
                there = seen.measured > 0
                if there.mean() > _SEEN_AGAIN:
                    shares.append(float((seen.expected[there] < NEARER * seen.measured[there]).mean()))
        return float(np.median(shares)) if len(shares) >= FEWEST_PAIRS else 0.0

    def clearly_better(self, one: Reading, other: Reading) -> bool:
        """True if frames explain each other with the one, and differ over twice as much with the other."""
        best = self.score(one)
        return best <= EXPLAINED and _BETTER * (best + _NOISE) < self.score(other) + _NOISE

    def best(self) -> Reading:
        """The reading that explains the frames and differs least from the given one, which stays unless
        another is clearly better."""
        kept, before = [self.given], None
        # Of two mistakes the one is sought in the presence of the other, so what is found is sought again.
        for _ in range(_ROUNDS):
            kept = self._best(self._best(kept, self._of_poses_and_unit, _FEW), self._of_camera, _MANY)
            if kept[0] == before or self.score(self.given) <= min(EXPLAINED, self.score(kept[0])):
                break
            before = kept[0]
        if self.score(kept[0]) > _WELL and self._has_pinholes:
            kept = self._best(kept, self._of_images, 1)
            kept = self._best(kept, self._of_camera, _FEW)
        if self._has_stamps:
            for step in _LATE_STEPS_S:
                kept = self._best(kept, partial(self._of_time, step=step), _FEW)
        if self._lenses:
            for step in _FOCAL_STEPS:
                kept = self._best(kept, partial(self._of_focal, step=step), _FEW)
        best = kept[0]
        for field in fields(Reading):
            simpler = replace(best, **{field.name: getattr(self.given, field.name)})
            tells = self._focal_tells if field.name == "focal" else self.clearly_better
            if not tells(best, simpler):
                best = simpler
        tells = self._focal_tells if best == replace(self.given, focal=best.focal) else self.clearly_better
        return best if tells(best, self.given) else self.given

    def _focal_tells(self, one: Reading, other: Reading) -> bool:
        """True if all but few pairs of frames differ less with the focal length of the one, by a third
        together. Of the clean recordings that were tried all differ least with the one that is stated."""
        if abs(one.focal / other.focal - 1) < _FOCAL_OFF:
            return False
        ours, theirs = self.differences(one), self.differences(other)
        told = self.usable() & ~np.isnan(ours) & ~np.isnan(theirs)
        return bool(
            told.sum() >= _FOCAL_PAIRS
            and (ours < theirs)[told].mean() >= _FOCAL_AGREE
            and self.score(one) <= min(EXPLAINED, self.score(other) / _FOCAL_BETTER)
        )

    def undecided(self, best: Reading) -> list[str]:
        """The assumptions whose contrary explains the frames nearly as well as the best reading does."""
        others = {
            QUESTIONS["inverse"]: [replace(best, inverse=not best.inverse)],
            QUESTIONS["w_first"]: [replace(best, w_first=not best.w_first)],
            QUESTIONS["axes"]: [replace(best, axes=a) for a in ("", *AXES) if a != best.axes],
            QUESTIONS["factor"]: [replace(best, factor=best.factor * times) for times in (0.2, 5.0, 1000.0)],
            QUESTIONS["turned"]: [replace(best, turned=t) for t in ("", *TURNS) if t != best.turned],
            QUESTIONS["along_ray"]: [replace(best, along_ray=not best.along_ray)],
            QUESTIONS["lens"]: [replace(best, lens=a) for a in [*LENSES][:2] if a != best.lens],
        }
        if not self._lenses:
            others = dict([*others.items()][:-3])
        late = [replace(best, late_s=best.late_s + late) for late in (-0.3, 0.3)] if self._has_stamps else []
        for each in (other for tried in [*others.values(), late] for other in tried):
            self.differences(each)
        limit = _AS_WELL * (self.score(best) + _NOISE) - _NOISE
        found = [name for name, tried in others.items() if min(map(self.score, tried)) < limit]
        times = [score for score in map(self.score, late) if score < 1]
        return found if times and min(times) >= limit else [*found, QUESTIONS["late_s"]]

    def _best(self, kept: Sequence[Reading], options: Options, count: int) -> list[Reading]:
        """Those kept, and what options make of the first ``count`` and of the given one; the best first."""
        taken = dict.fromkeys([*kept[:count], self.given])
        tried = dict.fromkeys(each for reading in taken for each in [reading, *options(reading)])
        for reading in tried:
            self.differences(reading)
        return sorted(dict.fromkeys([*kept, *tried]), key=self.score)

    def _of_poses_and_unit(self, reading: Reading) -> list[Reading]:
        ways = product((False, True), (False, True), ("", *AXES), (1.0, *self._units))
        return [replace(reading, w_first=w, inverse=i, axes=a, factor=f) for w, i, a, f in ways]

    def _of_images(self, reading: Reading) -> list[Reading]:
        """Turned images: poses and the unit of depth can only be sought together with the turn."""
        ways = product(TURNS, (False, True), ("", *AXES), self._of_depth)
        return [replace(reading, turned=t, inverse=i, axes=a, factor=f) for t, i, a, f in ways]

    def _of_camera(self, reading: Reading) -> list[Reading]:
        if not self._lenses:
            return []
        ways = product((False, True), ("", *self._lenses))
        found = [replace(reading, along_ray=ray, lens=lens) for ray, lens in ways]
        if len(self._cameras) > 1:
            ends = (next(iter(self._cameras)), next(reversed(self._cameras)))
            found += [replace(reading, camera=camera) for camera in ends]
        return found

    def _of_focal(self, reading: Reading, step: float) -> list[Reading]:
        """Focal lengths that are off by up to 30% at the first step, then by something near."""
        first = step == _FOCAL_STEPS[0]
        count = round((_FOCAL_REACH if first else _FOCAL_STEPS[0]) / step)
        return [replace(reading, focal=round(reading.focal + i * step, 4)) for i in range(-count, count + 1)]

    def _of_time(self, reading: Reading, step: float) -> list[Reading]:
        """Poses that are late or early: by up to a second at the first step, then by something near."""
        count = round((REACH_S if step == _LATE_STEPS_S[0] else _LATE_STEPS_S[0]) / step)
        return [
            replace(reading, late_s=round(reading.late_s + i * step, 4)) for i in range(-count, count + 1)
        ]


def points_of(view: View, reading: Reading) -> Floats:
    """The points (N, 3) of a view in the camera frame."""
    camera = view.camera
    if not isinstance(camera, PinholeCamera):
        return view.points * reading.factor
    rays = reading.stored_camera(camera).directions(view.u, view.v)
    if reading.along_ray:
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays * (view.points[:, 2:] * reading.factor)


def seen_by(view: View, points: Floats, T_second_first: Pose, reading: Reading) -> SeenAgain:
    """The points (N, 3) of another view in this one."""
    camera = view.camera
    if isinstance(camera, PinholeCamera):
        camera = reading.stored_camera(camera)
    seen = seen_again(points, T_second_first, view.image, camera)
    expected = seen.expected
    if reading.along_ray and isinstance(camera, PinholeCamera):
        expected = np.linalg.norm(points @ T_second_first[:3, :3].T + T_second_first[:3, 3], axis=1)
    return SeenAgain(expected, seen.measured * reading.factor, seen.rows, seen.columns)


def _off(
    camera: PinholeCamera | Sphere, looks: Sequence[tuple[Floats, View]], reading: Reading
) -> list[Floats]:
    """By how much the depths of points (N, 3), in the frames of views that one camera took, differ from those
    that the views measured, (N,) for each: 0 to 0.2."""
    points = np.concatenate([each for each, _ in looks])
    camera = reading.stored_camera(camera) if isinstance(camera, PinholeCamera) else camera
    expected, rows, columns = pixels_of(points, camera)
    if reading.along_ray and isinstance(camera, PinholeCamera):
        expected = np.linalg.norm(points, axis=1)
    ends = np.cumsum([len(each) for each, _ in looks])[:-1]
    pixels = zip(np.split(rows, ends), np.split(columns, ends), looks, strict=True)
    measured = np.concatenate([view.image[v, u] for v, u, (_, view) in pixels]) * reading.factor
    both = (rows >= 0) & (measured > 0)
    off = np.full(len(points), _WORST)
    expected, measured = expected[both], measured[both]
    off[both] = np.minimum(np.abs(expected - measured) / np.maximum(expected, measured), _WORST)
    return np.split(off, ends)
