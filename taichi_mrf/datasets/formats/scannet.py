"""ScanNet (Dai et al., CVPR 2017), extracted from its .sens files: depth/N.png, pose/N.txt, intrinsic/.

Depth is 16-bit millimetres; ``pose/N.txt`` holds T_world_camera of the depth camera as a 4 x 4 matrix, of
-inf where tracking was lost: such images are left out and counted. ``intrinsic/intrinsic_depth.txt`` is the
camera's 4 x 4 matrix. Colour images are of another size than depth, and not read.
"""

from functools import partial
from pathlib import Path

from taichi_mrf.datasets.base import Dataset, Format
from taichi_mrf.datasets.intrinsics import find_camera, read_camera
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.recording import RecordedFrame, Recording
from taichi_mrf.datasets.trajectories import read_matrix_file
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

NAME = "ScanNet"
CAMERA = PinholeCamera(width=640, height=480, fx=577.870605, fy=577.870605, cx=319.5, cy=239.5)
"""The camera of most scenes."""

INTRINSICS = "intrinsic/intrinsic_depth.txt"
STEPS_PER_METRE = 1000.0
FRAMES_PER_SECOND = 30.0
LOST = "inf"
"""The text in the pose file of an image that could not be tracked."""


def recognises(folder: Path) -> bool:
    """Whether there are a folder of depth images and one of poses."""
    return (folder / "depth").is_dir() and (folder / "pose").is_dir()


def open_folder(folder: Path, options: ReadOptions) -> Dataset:
    """List the tracked images in the order of their numbers. One whose pose is missing is listed, and named
    in an error when it is read."""
    images = sorted(
        (path for path in (folder / "depth").iterdir() if path.suffix == ".png" and path.stem.isdecimal()),
        key=lambda path: int(path.stem),
    )
    if not images:
        raise DatasetError(f"{folder / 'depth'}: contains no N.png")
    tracked = [path for path in images if not _lost(folder / "pose" / f"{path.stem}.txt")]
    if not tracked:
        raise DatasetError(f"{folder / 'pose'}: tracking was lost in all {len(images)} images")
    if options.camera is None and options.intrinsics is None and (folder / INTRINSICS).is_file():
        camera = read_camera(folder / INTRINSICS, CAMERA, iter(tracked))
        notes: list[str] = []
    else:
        camera, notes = find_camera(folder, options, CAMERA, NAME, iter(tracked))
    dropped = len(images) - len(tracked)
    if dropped:
        notes.append(f"{dropped} of {len(images)} images dropped: tracking was lost")
    return Recording(
        name=folder.name,
        camera=camera,
        notes=notes,
        dropped=dropped,
        frames=[_frame(folder, path) for path in tracked],
        steps_per_metre=options.depth_scale or STEPS_PER_METRE,
        scale_source="--depth-scale" if options.depth_scale else NAME,
        color=False,
    )


def _frame(folder: Path, path: Path) -> RecordedFrame:
    pose_file = folder / "pose" / f"{path.stem}.txt"
    return RecordedFrame(
        name=path.stem,
        stamp=int(path.stem) / FRAMES_PER_SECOND,
        depth_file=path,
        read_pose=partial(read_matrix_file, pose_file),
        pose_source=str(pose_file),
    )


def _lost(pose_file: Path) -> bool:
    try:
        return LOST in read_text(pose_file, DatasetError)
    except DatasetError:
        return False


FORMAT = Format(
    name=NAME,
    looks_for="depth/N.png and pose/N.txt",
    recognises=recognises,
    open=open_folder,
)
