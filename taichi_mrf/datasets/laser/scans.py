"""Scans of a 2D laser scanner with known poses, and what makes a scan unusable."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.laser.plan_image import FloorPlan
from taichi_mrf.factor_graph.beams import Beams


@dataclass(frozen=True)
class LaserScans:
    """N scans of B beams each, in one world frame.

    A beam of scan i leaves ``pose_x_y_theta[i]``, the pose of the scanner, at the angle theta + ``angle_rad``
    from the world's x axis, counter-clockwise. Ranges are positive; beams
    of range 0 are left out.
    """

    name: str

    range_m: NDArray[np.float32]
    """(N, B) measured range in metres; for a beam without a return, the scanner's greatest range."""

    angle_rad: NDArray[np.float64]
    """(B,) angles of the beams in the scanner's frame."""

    pose_x_y_theta: NDArray[np.float64]
    """(N, 3) metres, metres, radians."""

    hit: NDArray[np.bool_]
    """(N, B): False for beams without a return."""

    no_return_is_free: bool = True
    """Whether a beam without a return is evidence that the space up to its range is free. In logs of real
    scanners most such beams met glass or something dark, and carry no evidence."""

    floor_plan: FloorPlan | None = None
    """The true floor plan, if it comes with the scans."""

    notes: tuple[str, ...] = ()
    """Sentences for the report: what was assumed or left out."""

    def __len__(self) -> int:
        return len(self.range_m)


def problem_of_scan(range_m: NDArray[np.floating], pose_x_y_theta: NDArray[np.floating]) -> str | None:
    """The problem with the values of one scan, (B,) and (3,), or None."""
    bad = ~np.isfinite(range_m) | (range_m < 0)
    if bad.any():
        beam = int(bad.argmax())
        return f"the range of beam {beam + 1} is {range_m[beam]:g}; ranges are finite and not negative"
    if not np.isfinite(pose_x_y_theta).all():
        return f"the pose contains a value that is not finite: {' '.join(f'{v:g}' for v in pose_x_y_theta)}"
    return None


def skipped_note(problems: list[str]) -> tuple[str, ...]:
    """The note on scans that were left out, with one error text each; empty without such scans."""
    if not problems:
        return ()
    return (f"{len(problems)} broken scans were left out; the first: {problems[0]}",)


def beams_of(scans: LaserScans, max_range_m: float = 0.0, no_return_is_free: bool | None = None) -> Beams:
    """All beams of all scans, in their order, in the plane z = 0 of the world frame.

    A beam longer than ``max_range_m`` (0: no limit) is cut there and then only marks its way as free.
    Beams of range 0 are left out, and so are those without a return, unless they mark their way as free:
    ``no_return_is_free``, or by default what the scans have.
    """
    count, beams = scans.range_m.shape
    angle = scans.pose_x_y_theta[:, 2:] + scans.angle_rad
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1).reshape(-1, 3)
    origin = np.column_stack([scans.pose_x_y_theta[:, :2], np.zeros(count)])
    range_m, hit = scans.range_m.ravel(), scans.hit.ravel()
    used = range_m > 0
    if not (scans.no_return_is_free if no_return_is_free is None else no_return_is_free):
        used &= hit
    if max_range_m > 0:
        hit = hit & (range_m <= max_range_m)
        range_m = np.minimum(range_m, np.float32(max_range_m))
    return Beams(
        origins=np.repeat(origin, beams, axis=0)[used],
        directions=directions[used],
        range_m=range_m[used],
        hit=hit[used],
    )
