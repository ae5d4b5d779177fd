"""Which reader opens a source: a folder is recognised by what is in it, a built-in one by its name.

A new folder format is a module with NAME, LOOKS_FOR, ``recognises(folder)`` and
``open_folder(folder, options)``, and a place in FOLDER_FORMATS; the first that recognises a folder wins.
"""

import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.datasets import (
    mesh_sequence,
    numbered_depth,
    realsense,
    seven_scenes,
    stereo_pairs,
    synthetic_room,
    tum_rgbd,
)
from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.errors import DatasetError


class FolderFormat(Protocol):
    """What a format's module offers."""

    NAME: str
    LOOKS_FOR: str

    def recognises(self, folder: Path) -> bool:
        """Whether the folder is of this format, whatever state its files are in."""

    def open_folder(self, folder: Path, options: ReadOptions) -> Dataset:
        """List the recording's frames. Raises DatasetError."""


FOLDER_FORMATS: tuple[FolderFormat, ...] = (seven_scenes, tum_rgbd, numbered_depth, stereo_pairs)

_BUILT_IN: dict[str, Callable[[str, ReadOptions], Dataset]] = {
    synthetic_room.NAME: synthetic_room.open_synthetic_room,
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
    max_time_gap: float = 0.02,
) -> Dataset:
    """Open a recording (a folder) or a built-in source such as ``synthetic:room?frames=60``.

    ``camera`` takes the place of the intrinsics that the recording or its format gives, ``depth_scale``
    (steps per metre) that of the scale of its depth images. ``color=False`` leaves colour images
    unread. ``max_time_gap`` (seconds) bounds the difference in time between a depth image and the pose
    that it is given, in formats with stamps. Raises DatasetError, whose text names the source and says
    what was looked for.
    """
    options = ReadOptions(camera, depth_scale, color, max_time_gap)
    folder = Path(source)
    scheme = re.match(r"([a-z][a-z0-9_]+):", str(source))  # two letters at least: C:\ is a folder
    try:
        if scheme and not folder.exists():
            return _open_built_in(str(source), options)
        return _open_folder(folder, options)
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror}") from error


def recognise(folder: Path) -> FolderFormat | None:
    """The format of a folder, or None."""
    return next((each for each in FOLDER_FORMATS if each.recognises(folder)), None)


def _open_folder(folder: Path, options: ReadOptions) -> Dataset:
    if not folder.exists():
        raise DatasetError(
            f"{folder}: there is no such folder, nor a built-in source of that name ({', '.join(_BUILT_IN)})"
        )
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is a file; a recording is the folder that holds the images and poses")
    folder_format = recognise(folder)
    if folder_format is not None:
        return folder_format.open_folder(folder.resolve(), options)
    children = sorted(folder.iterdir())
    if not children:
        raise DatasetError(f"{folder}: the folder is empty; looked for {_looked_for()}")
    inside = [child.name for child in children if child.is_dir() and recognise(child)]
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
