"""Which reader opens a source: a folder is recognised by what is in it, a file by its name, a built-in one by
its.

A new folder format is a module with NAME, LOOKS_FOR, ``recognises(folder)`` and
``open_folder(folder, options)``, and a place in FOLDER_FORMATS; the first that recognises a folder wins.
"""

import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.datasets.formats import frames_npz, numbered_depth, replica, scannet, seven_scenes, tum_rgbd
from taichi_mrf.datasets.realsense import device as realsense
from taichi_mrf.datasets.resampled import resampled
from taichi_mrf.datasets.ros import bag as ros_bag
from taichi_mrf.datasets.stereo import kitti_pairs as stereo_pairs
from taichi_mrf.datasets.stereo import rig_file as stereo_file
from taichi_mrf.datasets.synthetic import corridor as synthetic_corridor
from taichi_mrf.datasets.synthetic import mesh_sequence
from taichi_mrf.datasets.synthetic import room as synthetic_room
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera


class FolderFormat(Protocol):
    """What a format's module offers."""

    NAME: str
    LOOKS_FOR: str

    def recognises(self, folder: Path) -> bool:
        """Whether the folder is of this format, whatever state its files are in."""

    def open_folder(self, folder: Path, options: ReadOptions) -> Dataset:
        """List the recording's frames. Raises DatasetError."""


FOLDER_FORMATS: tuple[FolderFormat, ...] = (
    seven_scenes,
    tum_rgbd,
    scannet,
    replica,
    numbered_depth,
    stereo_pairs,
    ros_bag,
    frames_npz,
)

FILES = ".bag, .mcap or .db3 (ROS), .npz (frames), .yaml (stereo pairs)"
"""What a file may be."""

_BUILT_IN: dict[str, Callable[[str, ReadOptions], Dataset]] = {
    synthetic_room.NAME: synthetic_room.open_synthetic_room,
    synthetic_corridor.NAME: synthetic_corridor.open_synthetic_corridor,
    mesh_sequence.NAME: mesh_sequence.open_mesh,
    realsense.NAME: realsense.open_realsense,
}
"""Name -> what opens it, given the text after the name's question mark, or after a name that ends in ':'."""


def open_dataset(
    source: str | Path,
    *,
    camera: PinholeCamera | None = None,
    depth_scale: float | None = None,
    color: bool = True,
    max_time_gap: float | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    undistort: tuple[float, ...] | None = None,
    image_scale: float = 1.0,
    track: bool = False,
) -> Dataset:
    """Open a recording (a folder or a file) or a built-in source such as ``synthetic:room?frames=60``.

    The keywords are the fields of :class:`ReadOptions`: what the recording does not say, or says wrongly.
    Raises DatasetError, whose text names the source and says what was looked for.
    """
    options = ReadOptions(camera, depth_scale, color, max_time_gap, intrinsics, undistort, image_scale, track)
    path = Path(source)
    scheme = re.match(r"([a-z][a-z0-9_]+):", str(source))  # two letters at least: C:\ is a folder
    try:
        if scheme and not path.exists():
            dataset = _open_built_in(str(source), options)
        else:
            dataset = _open_path(str(source), options)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from error
    return _as_wanted(dataset, options)


def _as_wanted(dataset: Dataset, options: ReadOptions) -> Dataset:
    """What all readers have in common: the caller's intrinsics, and images picked anew."""
    if options.intrinsics is not None:
        dataset.camera = PinholeCamera(dataset.camera.width, dataset.camera.height, *options.intrinsics)
    distortion = dataset.distortion if options.undistort is None else options.undistort
    picked = resampled(dataset, distortion, options.stride)
    picked.tracked = dataset.tracked or options.track
    return picked


def recognise(folder: Path) -> FolderFormat | None:
    """The format of a folder, or None."""
    return next((each for each in FOLDER_FORMATS if each.recognises(folder)), None)


def format_name(source: str | Path) -> str:
    """What the format of a source that can be opened is called."""
    path, _ = _path_and_query(str(source))
    if path.is_dir():
        found = recognise(path)
        return found.NAME if found is not None else "folder"
    if path.is_file():
        readers = (ros_bag, frames_npz)
        return next((each.NAME for each in readers if each.recognises_file(path)), stereo_file.NAME)
    return str(source).partition("?")[0]


def absolute_source(source: str) -> str:
    """The same source for a process that works in another folder."""
    path, query = _path_and_query(source)
    if not path.exists():
        return source
    return f"{path.resolve()}?{query}" if query else str(path.resolve())


def is_rendered(source: str) -> bool:
    """Whether a source is a built-in scene, whose frames can be read only once Taichi runs."""
    return source.partition("?")[0] in (synthetic_room.NAME, synthetic_corridor.NAME)


def bag_path(source: str) -> Path | None:
    """The bag that a source names, None if it is something else."""
    path, _ = _path_and_query(source)
    return path if ros_bag.is_bag(path) else None


def _path_and_query(source: str) -> tuple[Path, str]:
    """A path and what follows a question mark in its name, unless that is part of the path."""
    path, mark, query = source.rpartition("?")
    return (Path(path), query) if mark and not Path(source).exists() else (Path(source), "")


def _open_path(source: str, options: ReadOptions) -> Dataset:
    path, query = _path_and_query(source)
    if not path.exists():
        raise DatasetError(
            f"{path}: there is no such folder or file, nor a built-in source of that name "
            f"({', '.join(_BUILT_IN)})"
        )
    if ros_bag.is_bag(path):
        return ros_bag.open_bag(path, query, options)
    if query:
        raise DatasetError(f"{path}: takes no options after a question mark; bags and built-in sources do")
    return _open_folder(path, options) if path.is_dir() else _open_file(path, options)


def _open_file(path: Path, options: ReadOptions) -> Dataset:
    if frames_npz.recognises_file(path):
        return frames_npz.open_file(path, options)
    if path.suffix in stereo_file.SUFFIXES:
        return stereo_file.open_file(path, options)
    raise DatasetError(
        f"{path}: is a file, and none that is known here: {FILES}; other recordings are the folder that "
        "holds the images and poses"
    )


def _open_folder(folder: Path, options: ReadOptions) -> Dataset:
    folder_format = recognise(folder)
    if folder_format is not None:
        return folder_format.open_folder(folder.resolve(), options)
    children = sorted(folder.iterdir())
    if not children:
        raise DatasetError(f"{folder}: the folder is empty; looked for {_looked_for()}")
    inside = [
        child.name for child in children if ros_bag.is_bag(child) or (child.is_dir() and recognise(child))
    ]
    if inside:
        raise DatasetError(f"{folder}: holds recordings, is none itself; name one: {', '.join(inside[:8])}")
    raise DatasetError(f"{folder}: no recording that is known here; looked for {_looked_for()}")


def _looked_for() -> str:
    return "; ".join(f"{each.NAME}: {each.LOOKS_FOR}" for each in FOLDER_FORMATS)


def _open_built_in(source: str, options: ReadOptions) -> Dataset:
    name, _, query = source.partition("?")
    kind, _, rest = source.partition(":")
    if f"{kind}:" in _BUILT_IN:
        name, query = f"{kind}:", rest
    if name not in _BUILT_IN:
        near = difflib.get_close_matches(name, _BUILT_IN, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"built in are: {', '.join(_BUILT_IN)}"
        raise DatasetError(f"{source}: no such source; {hint}")
    return _BUILT_IN[name](query, options)
