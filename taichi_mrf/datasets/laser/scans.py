"""Scans of a 2D laser scanner with known poses, and what makes a scan unusable."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.plan_image import FloorPlan


@dataclass(frozen=True)
class LaserScans:
    """N scans of B beams each, in one world frame.

    A beam of scan i leaves ``pose_x_y_theta[i]``, the pose of the scanner, at the angle theta + ``angle_rad``
    from the world's x axis, counter-clockwise. Ranges are positive; a range of 0 is a beam that measured
    nothing at all.
    """

    name: str

    range_m: NDArray[np.float32]
    """(N, B) measured range in metres; where nothing came back, how far the scanner would have seen."""

    angle_rad: NDArray[np.float64]
    """(B,) angles of the beams in the scanner's frame."""

    pose_x_y_theta: NDArray[np.float64]
    """(N, 3) metres, metres, radians."""

    hit: NDArray[np.bool_]
    """(N, B): False where nothing came back."""

    no_return_is_free: bool = True
    """Whether a beam that did not come back says that the space up to its range is free. In logs of real
    scanners most such beams met glass or something dark and say nothing."""

    floor_plan: FloorPlan | None = None
    """The truth, if it comes with the scans."""

    notes: tuple[str, ...] = ()
    """Sentences that a report should show: what was assumed or left out."""

    def __len__(self) -> int:
        return len(self.range_m)


def problem_of_scan(range_m: NDArray[np.floating], pose_x_y_theta: NDArray[np.floating]) -> str | None:
    """What is wrong with the values of one scan, (B,) and (3,), or None."""
    bad = ~np.isfinite(range_m) | (range_m < 0)
    if bad.any():
        beam = int(bad.argmax())
        return f"the range of beam {beam + 1} is {range_m[beam]:g}; ranges are finite and not negative"
    if not np.isfinite(pose_x_y_theta).all():
        return f"the pose holds a value that is not finite: {' '.join(f'{v:g}' for v in pose_x_y_theta)}"
    return None


def skipped_note(problems: list[str]) -> tuple[str, ...]:
    """The note on scans that were left out, of which each has an error text; none if there are none."""
    if not problems:
        return ()
    return (f"{len(problems)} broken scans were left out; the first: {problems[0]}",)
