"""TUM RGB-D (Sturm et al., IROS 2012): depth.txt and groundtruth.txt, rgb.txt where there is colour.

depth.txt and rgb.txt hold ``stamp file`` lines, groundtruth.txt ``stamp tx ty tz qx qy qz qw``, which is
T_world_camera of the colour camera, to which the depth images are registered. Depth is 16-bit, 5000 steps
a metre. A depth image gets the pose nearest in time, if that is near enough; those without one are dropped
and counted.
"""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.entries import stamped_images
from taichi_mrf.datasets.intrinsics import find_camera
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, beside, recording
from taichi_mrf.datasets.timed_poses import apart_in_words, check_unit
from taichi_mrf.datasets.trajectories import (
    OTHERWISE,
    is_trajectory,
    poses_at_start,
    read_trajectory,
    stamps_a_second,
    valid_poses,
)
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_file, read_text

NAME = "TUM RGB-D"
STEPS_PER_METRE = 5000.0
LARGEST_GAP = 0.02
"""Default of the largest time in seconds between a depth image and its pose."""
LONGEST_NAME = 255
"""Bytes; common file systems allow no longer names."""
DEPTH_LIST, COLOR_LIST, POSES = "depth.txt", "rgb.txt", "groundtruth.txt"

CAMERAS = {
    "freiburg1": PinholeCamera(width=640, height=480, fx=517.3, fy=516.5, cx=318.6, cy=255.3),
    "freiburg2": PinholeCamera(width=640, height=480, fx=520.9, fy=521.0, cx=325.1, cy=249.7),
    "freiburg3": PinholeCamera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6),
}
"""The data set's calibrations of its three cameras, recognised by the folder's name."""


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the depth images that have a pose within the largest gap, by their stamps."""
    depth = _read_list(folder / DEPTH_LIST) if is_file(folder / DEPTH_LIST) else stamped_images(folder)
    poses = _poses(folder, options.track)
    stamps = [stamp for stamp, _ in depth]
    unposed = options.track and not is_file(poses)
    trajectory = poses_at_start(poses, "stamped", stamps) if unposed else read_trajectory(poses)
    if trajectory.layout != "stamped":
        raise DatasetError(f"{trajectory.path}: expected lines of stamp tx ty tz qx qy qz qw")
    gap = LARGEST_GAP if options.max_time_gap is None else options.max_time_gap
    known = [pose for pose in trajectory.poses if not pose.is_lost]
    partners = associate(stamps, [pose.key for pose in known], gap)
    matched = [
        (stamp, path, known[partner])
        for (stamp, path), partner in zip(depth, partners, strict=True)
        if partner is not None
    ]
    if 2 * len(matched) < len(depth):
        check_unit(stamps, [pose.key for pose in known], "depth images", str(folder), poses.name)
    if not matched:
        first, last = trajectory.poses[0].key, trajectory.poses[-1].key
        raise DatasetError(
            f"{folder}: none of {len(depth)} depth images ({stamps[0]:.3f} to {stamps[-1]:.3f} s) has a pose "
            f"within {gap:g} s ({poses.name}: {first:.3f} to {last:.3f} s)"
            + apart_in_words(stamps, [pose.key for pose in trajectory.poses], gap)
        )
    lost = len(trajectory.poses) - len(known)
    colors = _colors(folder, [stamp for stamp, _, _ in matched], options, gap)
    frames = [
        RecordedFrame(path.stem, stamp, pose.T_world_camera, pose.source, path, color)
        for (stamp, path, pose), color in zip(matched, colors, strict=True)
    ]
    default, default_name = _default_camera(folder)
    camera, notes = find_camera(folder, options, default, default_name, (f.depth_file for f in frames))
    dropped = len(depth) - len(frames)
    if lost:
        notes.append(f"{lost} of {len(trajectory.poses)} poses of {poses.name} left out: tracking was lost")
    if dropped:
        notes.append(f"{dropped} of {len(depth)} depth images dropped: no unused pose within {gap:g} s")
    track = partial(valid_poses, replace(trajectory, poses=tuple(known)))
    return recording(folder, options, camera, frames, STEPS_PER_METRE, NAME, notes, len(depth), track=track)


def _poses(folder: Path, may_lack: bool) -> Path:
    """The file of poses, or the only other one in the folder, as SLAM programs call theirs otherwise. Raises
    DatasetError if there is none and it ``may_lack`` none."""
    others = [] if is_file(folder / POSES) else [p for p in folder.glob("*.txt") if is_trajectory(p)]
    if is_file(folder / POSES) or len(others) == 1 or (may_lack and not others):
        return others[0] if others else folder / POSES
    names = ", ".join(path.name for path in others) or "there is no other file of poses"
    raise DatasetError(
        f"{folder / POSES}: is missing; {DEPTH_LIST} needs it for the poses ({names}); {OTHERWISE}"
    )


def associate(stamps: Sequence[float], others: Sequence[float], largest_gap: float) -> list[int | None]:
    """For each stamp (seconds) the index of its partner in ``others``, or None. No pair is further apart than
    ``largest_gap``, no partner is given twice, and the closest pairs are made first. Neither list needs to be
    sorted."""
    order = np.argsort(others, kind="stable")
    ordered = np.asarray(others, dtype=np.float64)[order]
    pairs = []
    for i, stamp in enumerate(stamps):
        # A little wider than the gap, to absorb the rounding of stamp +- gap.
        window = largest_gap + 2 * np.spacing(abs(stamp) + largest_gap)
        first = np.searchsorted(ordered, stamp - window, side="left")
        last = np.searchsorted(ordered, stamp + window, side="right")
        for j in range(first, last):
            gap = abs(stamp - ordered[j])
            if gap <= largest_gap:
                pairs.append((gap, i, int(order[j])))
    partner: list[int | None] = [None] * len(stamps)
    taken = set()
    for _, i, j in sorted(pairs):
        if partner[i] is None and j not in taken:
            partner[i] = j
            taken.add(j)
    return partner


def _colors(folder: Path, stamps: list[float], options: ReadOptions, gap: float) -> list[Path | None]:
    path = folder / COLOR_LIST
    if not (options.color and is_file(path)):
        return [None] * len(stamps)
    color = _read_list(path)
    partners = associate(stamps, [stamp for stamp, _ in color], gap)
    return [None if partner is None else color[partner][1] for partner in partners]


def _default_camera(folder: Path) -> tuple[PinholeCamera, str]:
    for name, camera in CAMERAS.items():
        if name in folder.name:
            return camera, f"{NAME} {name}"
    return PRIMESENSE, "ROS for a Kinect"


def _read_list(path: Path) -> list[tuple[float, Path]]:
    """``stamp file`` lines, sorted by stamp; the files are relative to the list's folder, also where they had
    another place on another computer."""
    lines = read_text(path, DatasetError).splitlines()
    entries: list[tuple[float, Path]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = re.split(r"[\s,;]+", line.strip(), maxsplit=1)
        if not entries and re.match(r"\W*(time|stamp)", words[0], re.IGNORECASE):
            continue  # names of columns
        try:
            stamp, file = float(words[0]), beside(path.parent, words[1].strip(" \t\"'"))
        except (ValueError, IndexError):
            raise DatasetError(f"{path} line {number}: expected a stamp and a file name") from None
        if not math.isfinite(stamp):
            raise DatasetError(f"{path} line {number}: the stamp is not finite")
        longest = max((len(os.fsencode(part)) for part in file.parts), default=0)
        if longest > LONGEST_NAME:
            raise DatasetError(f"{path} line {number}: no file has a name of {longest} bytes")
        entries.append((stamp, file))
    if not entries:
        raise DatasetError(f"{path}: lists no image")
    rate = stamps_a_second([stamp for stamp, _ in entries])
    return sorted((stamp / rate, file) for stamp, file in entries)
