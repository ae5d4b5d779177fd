"""Poses with stamps, and the pose in between two of them.

Poses and depth images have stamps of their own. At the time of a depth image the body is assumed on the
straight line between the neighbouring positions and on the great circle between the neighbouring rotations
(slerp: K. Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985). The gap
in time is bounded, so that no pose is invented where a trajectory has a hole.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.trajectories import RESTART_S, read_trajectory, rotation_of, valid_poses
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose

INTERPOLATION_GAP = 0.1
"""Default of the largest time in seconds between an image and a neighbouring pose: poses at 5 Hz and more."""

_SAME = 1e-7
"""Poses differ by less, metres and elements of a rotation, where one is written again and again."""

_SHORTER_UNITS = {1e3: ("ms", "milliseconds"), 1e6: ("us", "microseconds"), 1e9: ("ns", "nanoseconds")}
"""Units by how many are a second."""

_SINCE_1970_S = 1e8
"""Such stamps may have been larger numbers, which are read as milliseconds since 1970 or as shorter units."""

_OF_ONE_TIME = 0.5
"""Least share of the data within the time of the poses, for both to be of one recording."""

_NEARLY_EQUAL = 1e-9
"""Below this angle (radians) the chord stands for the arc, whose formula divides by its sine."""


def largest_gap(options: ReadOptions) -> float:
    """The largest time in seconds to a neighbouring pose that is interpolated."""
    return INTERPOLATION_GAP if options.max_time_gap is None else options.max_time_gap


def within_gap(
    stamps: Sequence[float],
    poses: Sequence[Pose | None],
    gap: float,
    what: str,
    where: str,
    source: str,
    posed: Sequence[float] | NDArray = (),
) -> tuple[list[tuple[int, Pose]], list[str]]:
    """The indices of the data (``what``, such as "images") that have a pose near enough in time, with these,
    and a note that counts the others. ``stamps`` are the data's, ``posed`` those of the poses in ``source``.
    Raises DatasetError, which begins with ``where``, if none has a pose."""
    found = [(i, pose) for i, pose in enumerate(poses) if pose is not None]
    if 2 * len(found) < len(stamps):
        check_unit(stamps, posed, what, where, source)
    if not found:
        span = f", {min(posed):.3f} to {max(posed):.3f} s" if len(posed) else ""
        raise DatasetError(
            f"{where}: none of {len(stamps)} {what} ({min(stamps):.3f} to {max(stamps):.3f} s) has poses "
            f"within {gap:g} s on both sides ({source}{span}){apart_in_words(stamps, posed, gap)}"
        )
    dropped = len(poses) - len(found)
    note = f"{dropped} of {len(poses)} {what} dropped: no poses within {gap:g} s on both sides"
    return found, [note] if dropped else []


def check_unit(
    stamps: Sequence[float] | NDArray, posed: Sequence[float] | NDArray, what: str, where: str, source: str
) -> None:
    """Raise DatasetError, which begins with ``where``, if the stamps of data (``what``) and of the poses in
    ``source`` run over the same time in units that differ by a thousand, a million or a billion."""
    s, p = np.asarray(stamps, np.float64), np.asarray(posed, np.float64)
    spans = [float(np.ptp(each)) if len(each) else 0.0 for each in (s, p)]
    if not all(0 < span < math.inf for span in spans):
        return
    power = round(math.log(spans[1] / spans[0], 1000))
    times = 1000.0 ** abs(power)
    s, p = (s, p / times) if power > 0 else (s / times, p)
    if times not in _SHORTER_UNITS or ((s >= p.min()) & (s <= p.max())).mean() < _OF_ONE_TIME:
        return
    short, unit = _SHORTER_UNITS[times]
    faster, slower = ("the poses", f"the {what}") if power > 0 else (f"the {what}", "the poses")
    so, remedy = f"so they seem to be {unit}", f"divide those of the {what} by {times:.0f}"
    if power > 0 and times < max(_SHORTER_UNITS) and min(posed) >= _SINCE_1970_S:
        so = "so their unit is not the one assumed"
        remedy = "add the line '# stamp_ns tx ty tz qx qy qz qw' (or stamp_us, stamp_ms) above its numbers"
    elif power > 0:
        remedy = f"add the line '# stamp_{short} tx ty tz qx qy qz qw' just above its numbers"
    of_poses, of_data = (f"{min(each):.6g} to {max(each):.6g}" for each in (posed, stamps))
    raise DatasetError(
        f"{where}: the stamps of {faster} are {times:.0f} times those of {slower} ({source}: {of_poses}, "
        f"{what}: {of_data}), {so}: {remedy}"
    )


def apart_in_words(stamps: Sequence[float], posed: Sequence[float] | NDArray, gap: float) -> str:
    """Reason why nothing has a pose, by the ``stamps`` of both in seconds, and the remedy; or empty."""
    if not len(stamps) or not len(posed):
        return ""
    first, last, begin, end = min(stamps), max(stamps), min(posed), max(posed)
    if last < begin or first > end:
        return (
            f": the clocks of sensor and poses are {abs(begin - first):.3f} s apart; poses with the sensor's "
            "stamps are needed, as ?poses=FILE"
        )
    usual = float(np.median(np.diff(np.unique(posed)))) if len(posed) > 1 else 0.0
    return (
        f": poses are {usual:.3g} s apart; --max-time-gap {usual:.2g} interpolates that far"
        if usual > gap
        else ""
    )


class TimedPoses:
    """A trajectory that interpolates the pose at any time inside it. ``stamps`` (N,) float64 are seconds,
    ascending; ``poses`` (N, 4, 4) take points of the moving frame to the fixed one. ``restarts`` counts how
    often the clock of poses that came one by one started again."""

    def __init__(self, stamps: Sequence[float] | NDArray, poses: Sequence[Pose] | NDArray) -> None:
        """Sort the poses by their stamps; of several with one stamp the last one given counts."""
        keys = np.asarray(stamps, np.float64)
        self.restarts = 0
        order = np.argsort(keys, kind="stable")
        last = np.append(np.diff(keys[order]) > 0, True)[: len(order)]
        self.stamps: NDArray[np.float64] = keys[order][last]
        self.poses: NDArray[np.float64] = np.asarray(poses, np.float64).reshape(-1, 4, 4)[order][last]

    def __len__(self) -> int:
        return len(self.stamps)

    def add(self, stamp: float, pose: Pose, keep_s: float) -> None:
        """Add a pose that has just come, and drop those that are more than ``keep_s`` seconds older than the
        newest; all, if it is older by more than a clock's restart."""
        newest = float(self.stamps.max(initial=stamp))
        again = stamp < newest - RESTART_S
        self.restarts += again
        kept = (self.stamps >= newest - keep_s) & (not again)
        stamps, poses = np.append(self.stamps[kept], stamp), np.append(self.poses[kept], pose[None], axis=0)
        merged = TimedPoses(stamps, poses)
        self.stamps, self.poses = merged.stamps, merged.poses

    def forget_after(self, stamp: float) -> None:
        """Drop the poses after a time, but for one that was sent once, which a robot may not send again."""
        if len(self) > 1:
            kept = self.stamps <= stamp
            self.stamps, self.poses = self.stamps[kept], self.poses[kept]

    @property
    def stands_still(self) -> bool:
        """True if several poses are all the same."""
        return len(self) > 1 and np.allclose(self.poses, self.poses[0], rtol=0, atol=_SAME)

    def at(self, stamp: float, largest_gap: float) -> Pose | None:
        """The pose (4, 4) at a time, or None. It is None outside the trajectory, and where the two neighbours
        in time are more than twice ``largest_gap`` seconds apart: a time midway between them is then further
        from both. A pose with this very stamp is its own neighbour on both sides."""
        after = int(np.searchsorted(self.stamps, stamp))
        # A little wider than the gap, to absorb the rounding of a difference.
        window = 2 * largest_gap + 4 * np.spacing(abs(stamp) + largest_gap)
        if after < len(self) and self.stamps[after] == stamp:
            return self.poses[after].copy()
        if not 0 < after < len(self):
            return None
        first, last = self.stamps[after - 1], self.stamps[after]
        if last - first > window:
            return None
        return interpolate(self.poses[after - 1], self.poses[after], (stamp - first) / (last - first))

    def posed(
        self, stamps: Sequence[float], options: ReadOptions, what: str, where: str, source: str
    ) -> tuple[list[tuple[int, Pose]], list[str]]:
        """The data (``what``) that have a pose near enough in time: :func:`within_gap`."""
        gap = largest_gap(options)
        return within_gap(
            stamps, [self.at(each, gap) for each in stamps], gap, what, where, source, self.stamps
        )

    def between(
        self, times: NDArray[np.float64], largest_gap: float
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The poses at many ``times`` (M,), (M, 4, 4), and which of them are known: those with a pose before
        and one after that are at most ``largest_gap`` seconds apart. A trajectory of one pose stands still.
        """
        times = np.asarray(times, np.float64)
        if len(self) == 1:
            return np.repeat(self.poses, len(times), axis=0), np.ones(len(times), dtype=bool)
        after = np.clip(np.searchsorted(self.stamps, times, side="right"), 1, len(self) - 1)
        gap = self.stamps[after] - self.stamps[after - 1]
        share = (times - self.stamps[after - 1]) / gap
        known = (share >= 0) & (share <= 1) & (gap <= largest_gap)
        return interpolate(self.poses[after - 1], self.poses[after], np.clip(share, 0, 1)), known


def interpolate(
    T_first: NDArray[np.float64], T_last: NDArray[np.float64], share: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    """The rigid transforms (..., 4, 4) at ``share`` (...), 0 to 1, of the way from the first to the last: the
    translation on the straight line, the rotation on the shorter arc, at constant angular velocity."""
    share = np.asarray(share, np.float64)
    q_first, q_last = quaternion(T_first[..., :3, :3]), quaternion(T_last[..., :3, :3])
    cosine = _dot(q_first, q_last)
    # q and -q are one rotation; the one with the positive cosine lies on the shorter arc.
    q_last, cosine = np.where((cosine < 0)[..., None], -q_last, q_last), np.abs(cosine)
    angle = np.arctan2(_length(q_last - cosine[..., None] * q_first), cosine)
    is_chord = angle < _NEARLY_EQUAL
    sine = np.where(is_chord, 1.0, np.sin(angle))[..., None]
    chord = (1 - share)[..., None] * q_first + share[..., None] * q_last
    arc = np.sin((1 - share) * angle)[..., None] * q_first + np.sin(share * angle)[..., None] * q_last
    q = np.where(is_chord[..., None], chord, arc / sine)
    T = np.zeros((*share.shape, 4, 4))
    T[..., :3, :3] = rotation_of(q / _length(q)[..., None])
    T[..., :3, 3] = (1 - share)[..., None] * T_first[..., :3, 3] + share[..., None] * T_last[..., :3, 3]
    T[..., 3, 3] = 1.0
    return T


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (...) of vectors (..., n)."""
    return np.sqrt(_dot(vectors, vectors))


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scalar products (...) of vectors (..., n)."""
    return (a[..., None, :] @ b[..., :, None])[..., 0, 0]


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """x y z w, (..., 4), of rotations (..., 3, 3): the eigenvector to the largest eigenvalue of a symmetric
    matrix (I. Bar-Itzhack, "New Method for Extracting the Quaternion from a Rotation Matrix", JGCD 2000),
    which needs no cases and keeps its digits at every angle."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(R, (-2, -1), (0, 1))
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    return np.linalg.eigh(np.moveaxis(K, (0, 1), (-2, -1)))[1][..., -1]


def read_timed_poses(path: Path) -> TimedPoses:
    """A file of ``stamp tx ty tz qx qy qz qw`` lines (TUM RGB-D), T_world_camera. The lines may come in any
    order; a blank or a comma separates values. Raises DatasetError, which names the file and the line, if it
    is missing, of another layout, or contains no valid pose; warns of invalid ones, which are left out."""
    trajectory = read_trajectory(path)
    if trajectory.layout != "stamped":
        raise DatasetError(f"{path}: poses without stamps; expected stamp tx ty tz qx qy qz qw on each line")
    return TimedPoses(*valid_poses(trajectory))
