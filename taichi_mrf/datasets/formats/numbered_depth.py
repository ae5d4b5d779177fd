"""ICL-NUIM, Redwood and their like: numbered depth PNGs and one file with the trajectory.

The images lie in the folder itself or in ``depth/`` (colour in ``rgb/``, ``color/`` or ``image/``). The
trajectory may be ``scene/trajectory.log``, where Open3D's reconstruction system writes it; its layout decides
the defaults:

- stamped (``*.freiburg``; Handa et al., ICRA 2014): the stamp is the image's number; ICL-NUIM's camera, 5000
  steps a metre. ICL-NUIM's world and camera have y up and are left-handed (its fy is -480); both are
  mirrored here. The published trajectories start at image 1; what lies outside them is dropped and counted.
- ``.log`` (Choi et al., CVPR 2015) and Open3D's ``.json``: Redwood's camera, 525 525 319.5 239.5, or the one
  that the trajectory holds; 1000 steps a metre.
- rows of 3 x 4 matrices: 5000 steps a metre, ICL-NUIM's camera where the folder's name holds ``icl``, else
  Redwood's.

A camera file in the folder or the caller's options replace all of these. An assumed depth scale is checked
against the poses (depth_scale.py), and the notes name what was assumed.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.entries import NUMBERED_FILES, NUMBERED_IMAGE, numbered_images
from taichi_mrf.datasets.formats.tum_rgbd import LARGEST_GAP, associate
from taichi_mrf.datasets.hints import image_hint, pose_files_hint, unread_poses
from taichi_mrf.datasets.images import holds_depth
from taichi_mrf.datasets.intrinsics import (
    CAMERA_FILES,
    find_camera,
    is_trajectory_json,
    own_cameras,
    read_trajectory_json,
)
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, first_file, recording
from taichi_mrf.datasets.trajectories import (
    OTHERWISE,
    RecordedPose,
    Trajectory,
    in_seconds,
    is_trajectory,
    poses_at_start,
    read_trajectory,
)
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import is_file

NAME = "ICL-NUIM / Redwood"
ICL_NUIM = PinholeCamera(width=640, height=480, fx=481.2, fy=480.0, cx=319.5, cy=239.5)
FRAMES_PER_SECOND = 30.0
OPEN3D_LOG = "scene/trajectory.log"
COLOR_FOLDERS = ("rgb", "color", "image")

_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the images in the order of their numbers, each with its pose of the trajectory."""
    images = numbered_images(folder)
    found = _find_trajectory(folder, list(images.values()), options.track)
    trajectory = found or poses_at_start(folder, "rows", images)
    gap = LARGEST_GAP if options.max_time_gap is None else options.max_time_gap
    poses, notes = _poses_by_number(list(images), trajectory, gap)
    left_handed = trajectory.path.suffix == ".freiburg"
    if left_handed:
        notes.append(f"{trajectory.path.name}: mirrored in y, out of ICL-NUIM's left-handed world")
    lost = [number for number, pose in poses.items() if pose is not None and pose.is_lost]
    if lost:
        notes.append(f"{len(lost)} of {len(images)} images dropped: tracking was lost")
    posed = [number for number in images if number in poses and number not in lost]
    of_images = [poses[number] for number in posed]
    own = own_cameras([None if pose is None else pose.camera for pose in of_images], options)
    frames = [
        _frame(folder, number, images[number], trajectory, poses[number], left_handed) for number in posed
    ]
    if not frames:
        raise DatasetError(f"{trajectory.path}: has a pose for none of the {len(images)} images in {folder}")
    redwood = trajectory.layout == "log" or (trajectory.layout == "rows" and "icl" not in folder.name.lower())
    default, name = (PRIMESENSE, "Redwood") if redwood else (ICL_NUIM, "ICL-NUIM")
    recorded = own[0]
    camera, assumed = find_camera(
        folder, options, recorded or default, name, (frame.depth_file for frame in frames)
    )
    if recorded is not None and camera == recorded:
        assumed = []
        frames = [replace(frame, camera=each) for frame, each in zip(frames, own, strict=True)]
    return recording(
        folder,
        options,
        camera,
        frames,
        1000.0 if trajectory.layout == "log" else 5000.0,
        f"assumed as {name} has it",
        assumed + notes,
        len(images),
        scale_assumed=options.depth_scale is None,
    )


def _find_trajectory(folder: Path, images: Sequence[Path], may_lack: bool) -> Trajectory | None:
    """The only trajectory of a recording; None if it ``may_lack`` one, and does."""
    suffixes = (".txt", ".log", ".freiburg")
    candidates = [
        path
        for path in sorted(folder.iterdir())
        if (path.suffix in suffixes and path.name not in CAMERA_FILES and is_trajectory(path))
        or (path.suffix == ".json" and is_trajectory_json(path))
    ] or [path for path in (folder / OPEN3D_LOG,) if is_file(path)]
    if not candidates and may_lack and any(map(holds_depth, images[:2])):
        return None
    if len(candidates) != 1 and (hint := pose_files_hint(folder, images)):
        raise DatasetError(f"{folder}: {hint}")
    if not candidates and not any(map(holds_depth, images[:2])):
        raise DatasetError(f"{folder}: {image_hint(images[:2], 'holds images')}")
    if not candidates:
        raise DatasetError(
            f"{folder}: numbered images without a trajectory; looked for {NUMBERED_FILES}"
            f"{unread_poses(folder)}; {OTHERWISE}"
        )
    if len(candidates) > 1:
        names = ", ".join(path.name for path in candidates)
        raise DatasetError(
            f"{folder}: contains several trajectories, {names}; keep one of them in the folder"
        )
    if candidates[0].suffix == ".json":
        return read_trajectory_json(candidates[0])
    return read_trajectory(candidates[0])


def _poses_by_number(
    numbers: list[int], trajectory: Trajectory, gap: float
) -> tuple[dict[int, RecordedPose | None], list[str]]:
    """The pose of each image number, None where one is missing, and notes for the report. Numbers outside a
    stamped trajectory are left out, and so are those that are times (ms, us or ns since 1970) without a pose
    within the ``gap`` in seconds. Poses without stamps go with the images in their order if there are as
    many, else by number."""
    poses, name = trajectory.poses, trajectory.path.name
    by_key = {pose.key: pose for pose in poses}
    if trajectory.layout == "stamped" and in_seconds(numbers[0]) != numbers[0]:
        partners = associate([in_seconds(number) for number in numbers], [pose.key for pose in poses], gap)
        timed = {n: poses[i] for n, i in zip(numbers, partners, strict=True) if i is not None}
        dropped = len(numbers) - len(timed)
        note = f"{dropped} of {len(numbers)} images dropped: no unused pose within {gap:g} s in {name}"
        return dict(timed), [note] if dropped else []
    if trajectory.layout == "stamped" and not all(float(key).is_integer() for key in by_key):
        if len(poses) != len(numbers):
            raise DatasetError(
                f"{trajectory.path}: its stamps are times, images are numbered, and {len(numbers)} images "
                f"cannot be matched with {len(poses)} poses by their order; name the images by their stamps, "
                "or give one pose for each"
            )
        ordered = sorted(poses, key=lambda pose: pose.key)
        return dict(zip(numbers, ordered, strict=True)), [f"poses of {name} are taken in order"]
    if trajectory.layout == "stamped":
        first_key, last_key = min(by_key), max(by_key)
        inside = [number for number in numbers if first_key <= number <= last_key]
        dropped = len(numbers) - len(inside)
        note = f"{dropped} of {len(numbers)} images dropped: outside the trajectory in {name}"
        return {number: by_key.get(number) for number in inside}, [note] if dropped else []
    if len(poses) == len(numbers):
        return dict(zip(numbers, poses, strict=True)), []
    # With poses for all numbers, images were taken out of the recording; with fewer, the poses end early.
    if trajectory.layout == "log" and set(by_key) < set(numbers):
        note = f"{len(numbers) - len(by_key)} of {len(numbers)} images dropped: {name} has no pose for them"
        return {number: by_key[number] for number in numbers if number in by_key}, [note]
    first = 0 if numbers[-1] <= max(by_key) else numbers[0]
    note = f"{len(numbers)} images but {len(poses)} poses in {name}: took pose 0 for image {first}, and so on"
    return {number: by_key.get(number - first) for number in numbers}, [note]


def _frame(
    folder: Path, number: int, path: Path, trajectory: Trajectory, pose: RecordedPose | None, mirror: bool
) -> RecordedFrame:
    colors = (folder / place / f"{path.stem}{end}" for place in COLOR_FOLDERS for end in (".png", ".jpg"))
    source = str(trajectory.path) if pose is None else pose.source
    read, stamp = partial(_read_pose, trajectory.path, pose, mirror), _stamp(path, number, trajectory)
    return RecordedFrame(path.stem, stamp, read, source, path, first_file(colors))


def _stamp(path: Path, number: int, trajectory: Trajectory) -> float:
    """Time of an image, in seconds: from its name if it tells, else from its number. Files of matrices do
    not state their rate."""
    named = NUMBERED_IMAGE.fullmatch(path.name)
    if named is not None and named[3] is not None:
        return int(named[3][1:]) / 1e6
    if in_seconds(number) != number:
        return in_seconds(number)
    return float(number) if trajectory.layout == "rows" else number / FRAMES_PER_SECOND


def _read_pose(path: Path, pose: RecordedPose | None, mirror: bool) -> Pose:
    if pose is None:
        raise DatasetError(f"{path}: has no pose for this image")
    T_world_camera = pose.T_world_camera()
    return _MIRROR_Y @ T_world_camera @ _MIRROR_Y if mirror else T_world_camera
