"""Do depth and poses agree? The camera's steps by alignment of depth images, against the recorded steps.

A wrong stereo baseline, a wrong depth scale or poses in other units make depth and poses disagree by a
factor. Maps of such a recording are smeared, whatever the parameters. So a few pairs of keyframes are
aligned, depth to depth, and the lengths of their steps compared with the recorded ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levels import LEAST_POINTS, aligned, grids_of, levels_of
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.point_to_plane import NormalEquations
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.surfels import surfels_of
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.methods.protocol import PosedDepth
from taichi_mrf.sensor.noise import NoiseModel

PAIRS = 24
"""Pairs that are aligned at most, evenly spread over the keyframes: about a second."""

POINTS = 8000
"""Points of a depth image that are aligned, about."""

FEWEST_KEYFRAMES = 20
"""Recordings with fewer keyframes are not checked: too few of their pairs would tell their step."""

FEWEST_PAIRS = 5
"""With fewer pairs whose depth determines the step there is no result."""

OBSERVABLE = 0.0005
"""Least share of the largest eigenvalue that a direction needs to be aligned, as in alignment/locate.py."""

STEP = (0.05, 0.3)
"""Lengths of a pair's step, as shares of the median depth: shorter steps drown in the noise, and after
longer ones too little is seen by both."""

CELL = 0.03
"""Width of a surface cell as a share of the median depth."""

FREE = PoseConfig(translation_sigma=0.3, rotation_sigma=0.1)
"""Recorded poses count for next to nothing here: the depth is to tell the step."""

LEAST_OVERLAP = 0.5
"""Share of a keyframe's points that must have a surface near them."""

LARGEST_DEVIATION = 0.03
"""Expected deviation of the ratio of one pair; others do not tell the length of their step."""

SMALLEST_DIFFERENCE = 0.03
"""Ratios nearer to one than this are not reported: the depth of a Kinect 1 is wrong by 2%."""

DEVIATIONS = 4.0
"""A ratio is reported if it differs from one by so many of its standard deviations."""

LEAST_DEVIATION = 0.02
"""Deviation of one pair's ratio at least, however well few pairs agree by chance."""


@dataclass(frozen=True)
class StepCheck:
    """``ratio``: length of the aligned step over that of the recorded one, the median over ``pairs`` pairs of
    keyframes; ``deviation``: its standard deviation."""

    ratio: float
    deviation: float
    pairs: int

    @property
    def disagrees(self) -> bool:
        """True if the ratio differs from one by more than errors of alignment explain."""
        return abs(self.ratio - 1.0) > max(SMALLEST_DIFFERENCE, DEVIATIONS * self.deviation)


def check_steps(
    keyframes: Mapping[int, PosedDepth], T_recorded: Mapping[int, Pose], noise: NoiseModel, max_depth: float
) -> StepCheck | None:
    """Compare the steps between keyframes at their recorded poses, (4, 4) by id, with those found by
    aligning their depth. Depth beyond ``max_depth`` metres does not count. None if the depth of too few
    pairs determines their step."""
    ids = [id for id in T_recorded if id in keyframes]
    if len(ids) < FEWEST_KEYFRAMES:
        return None
    ratios = []
    points_of = cache(lambda i: _points(keyframes[ids[i]], noise, max_depth))
    for first, second in _pairs([keyframes[id] for id in ids], [T_recorded[id] for id in ids]):
        there, points = points_of(first), points_of(second)
        T_first_second = inverse(T_recorded[ids[first]]) @ T_recorded[ids[second]]
        ratio = _ratio(there, points, T_first_second, CELL * _median_depth(keyframes[ids[first]]))
        if ratio is not None:
            ratios.append(ratio)
    if len(ratios) < FEWEST_PAIRS:
        return None
    middle = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) - middle)))
    deviation = 1.2533 * max(spread, LEAST_DEVIATION) / math.sqrt(len(ratios))
    return StepCheck(middle, deviation, len(ratios))


def _pairs(keyframes: Sequence[PosedDepth], poses: Sequence[Pose]) -> list[tuple[int, int]]:
    """Pairs of keyframes one of which follows soon after the other, with steps that can be measured."""
    found = []
    for first, keyframe in enumerate(keyframes):
        least, most = np.multiply(STEP, _median_depth(keyframe))
        for second in range(first + 1, min(first + 20, len(keyframes))):
            step = float(np.linalg.norm(poses[second][:3, 3] - poses[first][:3, 3]))
            if step > most:
                break
            if step >= least:
                found.append((first, second))
                break
    some = np.linspace(0, len(found) - 1, min(PAIRS, len(found))).round().astype(int)
    return [found[k] for k in some]


def _median_depth(keyframe: PosedDepth) -> float:
    measured_m = keyframe.depth_m[keyframe.depth_m > 0]
    return float(np.median(measured_m)) if len(measured_m) else 0.0


def _points(keyframe: PosedDepth, noise: NoiseModel, max_depth: float) -> OrientedPoints:
    image = DepthImage.upload(keyframe.depth_m, keyframe.camera, noise, own=keyframe.own)
    return oriented_points(image, max_depth).about(POINTS)


def _ratio(there: OrientedPoints, points: OrientedPoints, T_first_second: Pose, cell: float) -> float | None:
    """Aligned over recorded step of a pair, whose ``points`` are aligned with the surface in ``there``, in
    cells of that many metres. None if depth does not tell it."""
    if min(len(there.points), len(points.points)) < LEAST_POINTS:
        return None
    levels = levels_of(points, grids_of(surfels_of(there, np.eye(4), cell), 2 * cell))
    lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
    found = aligned(levels, T_first_second, Recorded(T_first_second, FREE), lever_m, OBSERVABLE)
    if found.equations.overlap < LEAST_OVERLAP or found.directions < 6:
        return None
    rotation = T_first_second[:3, :3]
    step = rotation.T @ T_first_second[:3, 3]
    excess = rotation.T @ (found.T_world_camera[:3, 3] - T_first_second[:3, 3])
    information = _of_translation(found.equations)
    strength = float(step @ information @ step)
    if strength <= 0 or 1.0 / math.sqrt(strength) > LARGEST_DEVIATION:
        return None
    return 1.0 + float(step @ information @ excess) / strength


def _of_translation(equations: NormalEquations) -> NDArray[np.float64]:
    """(3, 3) information on the translation, whatever the rotation is: the Schur complement of the
    rotation."""
    H = equations.worth * equations.H
    return H[:3, :3] - H[:3, 3:] @ np.linalg.solve(H[3:, 3:], H[3:, :3])
