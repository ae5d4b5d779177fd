"""Rectified stereo pairs of any layout, described by a YAML file: ``taichi-mrf map rig.yaml``.

::

fx: 707.1 # pixels; fy is fx unless it is given cx: 601.9 cy: 183.1 baseline: 0.537 # metres left: cam0/*.png
# relative to this file, paired in the order of their names right: cam1/*.png poses: poses.txt #
T_world_camera of the left camera, in any layout that trajectories have times: times.txt # optional: a stamp
in seconds for each pair

Poses with stamps are interpolated at the pairs' own: those of ``times``, else the images' names as seconds,
or as nanoseconds if they are whole numbers of 16 digits or more. Other poses go with the pairs in their
order.
"""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path

import numpy as np

from taichi_mrf.config.files import read_yaml
from taichi_mrf.config.values import from_dict
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.stereo.matching import (
    RecordedPair,
    StereoMatching,
    StereoPairs,
    StereoRig,
    noise_note,
    read_times,
    size_of_pairs,
)
from taichi_mrf.datasets.timed_poses import read_timed_poses
from taichi_mrf.datasets.trajectories import read_trajectory
from taichi_mrf.errors import ConfigError, DatasetError, naming
from taichi_mrf.geometry.poses import as_pose
from taichi_mrf.sensor.camera import PinholeCamera

SECONDS_PER_PAIR = 0.1
_NANOSECOND_DIGITS = 16


@dataclass(frozen=True)
class RigFile:
    """The content of the file. Paths are relative to it."""

    fx: float
    """Focal length across, in pixels."""

    cx: float
    """Column of the principal point."""

    cy: float
    """Row of the principal point."""

    baseline: float
    """Distance of the cameras in metres."""

    left: str
    """The left images: a pattern such as cam0/*.png."""

    right: str
    """The right images."""

    poses: str
    """The file of the left camera's poses."""

    fy: float | None = None
    """Focal length down, in pixels; that across unless it is given."""

    times: str | None = None
    """A file with a stamp in seconds a line."""

    matching: StereoMatching = field(default_factory=StereoMatching)
    """Matching of the pairs."""


def open_file(path: Path, options: ReadOptions) -> Dataset:
    """List the pairs of a description. Raises DatasetError, which names the file and the field."""
    described, folder = _read(path), path.parent
    if options.depth_scale is not None:
        raise DatasetError(f"{path}: takes no depth_scale: depth comes from stereo pairs")
    left, right = (_images(path, side, getattr(described, side)) for side in ("left", "right"))
    if len(left) != len(right):
        raise DatasetError(f"{path}: {len(left)} left images but {len(right)} right ones")
    rig = _rig(path, described, left, options)
    stamps = _stamps(folder, described, left)
    pairs, notes, dropped = _pairs(
        folder / described.poses, list(zip(left, right, strict=True)), stamps, options
    )
    return StereoPairs(
        name=path.stem,
        camera=rig.camera,
        notes=[noise_note(rig, described.left, described.right), *notes],
        dropped=dropped,
        rows=pairs,
        baseline_m=rig.baseline_m,
        color=options.color,
        matching=described.matching,
    )


def _read(path: Path) -> RigFile:
    with naming("", ConfigError):
        values = read_yaml(path)
        for known in fields(RigFile):
            needed = known.default is MISSING and known.default_factory is MISSING
            if needed and isinstance(values, dict) and known.name not in values:
                raise DatasetError(f"{path}: {known.name} is missing in this description of stereo pairs")
        return from_dict(RigFile, values if isinstance(values, dict) else str(values), str(path))


def _images(path: Path, side: str, pattern: str) -> list[Path]:
    try:
        found = sorted(path.parent.glob(pattern), key=lambda image: (len(image.stem), image.name))
    except (ValueError, NotImplementedError) as error:  # an absolute or an empty pattern
        raise DatasetError(
            f"{path}: {side}: {pattern!r} is not a relative pattern of files: {error}"
        ) from error
    if not found:
        raise DatasetError(f"{path}: {side}: no file matches {pattern}")
    return found


def _rig(path: Path, described: RigFile, left: Sequence[Path], options: ReadOptions) -> StereoRig:
    with naming(path, ConfigError):
        if options.camera is not None:
            return StereoRig(options.camera, described.baseline)
        fy = described.fx if described.fy is None else described.fy
        own = (described.fx, fy, described.cx, described.cy)
        camera = PinholeCamera(*size_of_pairs(path, left), *(options.intrinsics or own))
        return StereoRig(camera, described.baseline)


def _stamps(folder: Path, described: RigFile, left: Sequence[Path]) -> list[float] | None:
    """Each pair's stamp in seconds, None if neither a file nor the names give it."""
    if described.times is not None:
        stamps = read_times(folder / described.times)
        if len(stamps) != len(left):
            raise DatasetError(
                f"{folder / described.times}: contains {len(stamps)} stamps for {len(left)} pairs"
            )
        return stamps
    try:
        values = [float(image.stem) for image in left]
    except ValueError:
        return None
    if not np.isfinite(values).all():  # a file called nan.png
        return None
    whole = all(image.stem.isdecimal() for image in left)
    if whole:
        return [v / 1e9 for v in values] if len(left[0].stem) >= _NANOSECOND_DIGITS else None
    return values


def _pairs(
    poses_file: Path,
    images: Sequence[tuple[Path, Path]],
    stamps: Sequence[float] | None,
    options: ReadOptions,
) -> tuple[list[RecordedPair], list[str], int]:
    """The pairs that have a pose, notes, and how many have none."""
    trajectory = read_trajectory(poses_file)
    if trajectory.layout == "stamped":
        if stamps is None:
            raise DatasetError(f"{poses_file}: has stamps, but the images have none; add times: FILE")
        timed, where = read_timed_poses(poses_file), str(poses_file)
        posed, notes = timed.posed(stamps, options, "stereo pairs", where, poses_file.name)
        pairs = [RecordedPair(images[i][0].stem, stamps[i], as_pose(T), where, *images[i]) for i, T in posed]
        return pairs, notes, len(images) - len(pairs)
    if len(trajectory.poses) != len(images):
        raise DatasetError(
            f"{poses_file}: contains {len(trajectory.poses)} poses for {len(images)} stereo pairs"
        )
    notes = []
    if stamps is None:
        stamps = [SECONDS_PER_PAIR * i for i in range(len(images))]
        notes.append(f"no stamps: assumed {SECONDS_PER_PAIR:g} s from one pair to the next")
    pairs = [
        RecordedPair(left.stem, stamp, pose.T_world_camera, pose.source, left, right)
        for (left, right), stamp, pose in zip(images, stamps, trajectory.poses, strict=True)
    ]
    return pairs, notes, 0
