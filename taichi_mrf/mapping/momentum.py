"""Prediction of a tracked camera's place from its momentum, and from its accelerometer's measurements since.

The velocity follows from the last two places and the accelerations between them; over the next step both
are integrated. Gravity along the world's axes is learnt on the way, by a Kalman filter: the place that is
found for a frame lies (t1 + t2) t2 / 2 times the error of gravity from the prediction, after steps of t1
and t2 seconds. So it need not be known at the beginning, and takes up most of the accelerometer's bias and
of the first frame's tilt.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.rules import RULES
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.motion import times_within


@dataclass(frozen=True)
class _Step:
    """A step of ``seconds``: by how much what is measured, gravity included, would change velocity (m/s) and
    place (m), along the world's axes; and how the camera turns in it, (3, 3)."""

    seconds: float
    velocity: NDArray[np.float64]
    place: NDArray[np.float64]
    R_begin_end: NDArray[np.float64]


class Momentum:
    """Predicts places. ``gravity_m_s2`` (3,) is what the accelerometer measures at rest, along the axes of
    the world; None until it is needed. ``proven`` says whether the last frame was found where it was
    predicted."""

    def __init__(self) -> None:
        self.gravity_m_s2: NDArray[np.float64] | None = None
        self.proven = False
        self._variance = RULES.first_gravity_m_s2**2
        self._said: tuple[Frame, Pose, float] | None = None
        """The frame, its prediction, and by how much that falls short for each m/s^2 of gravity."""

    def ahead(
        self,
        frame: Frame,
        before: tuple[float, Pose],
        last: tuple[float, Pose],
        bias_rad_s: NDArray[np.float64],
    ) -> Pose | None:
        """The pose (4, 4) of the camera at a frame, from those at two stamps before it; None if what was
        measured does not tell. ``bias_rad_s`` (3,) is the gyroscope's."""
        self._said = None
        first = _measured(frame, *before, last[0], bias_rad_s)
        second = _measured(frame, *last, frame.stamp, bias_rad_s)
        if first is None or second is None or frame.acceleration is None:
            return None
        t1, t2 = first.seconds, second.seconds
        if self.gravity_m_s2 is None:
            self.gravity_m_s2 = (first.velocity + second.velocity) / (t1 + t2)
        g, at_m = self.gravity_m_s2, frame.acceleration.position_m
        p1, p2 = (T[:3, :3] @ at_m + T[:3, 3] for _, T in (before, last))
        velocity = (p2 - p1 - first.place + g * t1**2 / 2) / t1 + first.velocity - g * t1
        T = np.eye(4)
        T[:3, :3] = last[1][:3, :3] @ second.R_begin_end
        T[:3, 3] = p2 + velocity * t2 + second.place - g * t2**2 / 2 - T[:3, :3] @ at_m
        self._said = frame, T, (t1 + t2) * t2 / 2
        return T

    def note(self, frame: Frame, T_now: Pose) -> None:
        """Learn from where the camera was found at the frame that was asked for last, (4, 4)."""
        self.proven = False
        if self._said is None or self._said[0] is not frame or self.gravity_m_s2 is None:
            return
        _, T_said, lever = self._said
        missed_m = T_now[:3, 3] - T_said[:3, 3]
        self.proven = bool(np.linalg.norm(missed_m) < RULES.proven_m)
        variance = self._variance + RULES.gravity_drift_m_s2**2
        share = variance / (variance + (RULES.found_place_m / lever) ** 2)
        self._variance = (1 - share) * variance
        self.gravity_m_s2 = self.gravity_m_s2 - share / lever * missed_m


def _measured(
    frame: Frame, begin_s: float, T_begin: Pose, end_s: float, bias_rad_s: NDArray[np.float64]
) -> _Step | None:
    """A step from a pose, None where samples are missing or it takes too long."""
    if frame.gyro is None or frame.acceleration is None or not end_s - begin_s <= RULES.longest_integrated_s:
        return None
    samples = frame.acceleration
    times = times_within(samples.stamps_s, begin_s, end_s)
    turns = None if times is None else frame.gyro.turns(times, bias_rad_s)
    if times is None or turns is None:
        return None
    here = [np.interp(times, samples.stamps_s, along) for along in samples.accelerations_m_s2.T]
    a = np.einsum("ij,njk,kn->ni", T_begin[:3, :3], turns, np.stack(here))
    dt = np.diff(times)[:, None]
    # Straight from one sample to the next.
    gained = np.cumsum((a[:-1] + a[1:]) / 2 * dt, axis=0)
    speeds = gained - (a[:-1] + a[1:]) / 2 * dt
    place = np.sum(speeds * dt + (2 * a[:-1] + a[1:]) * dt**2 / 6, axis=0)
    return _Step(end_s - begin_s, gained[-1], place, turns[-1])
