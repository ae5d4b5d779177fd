"""When each image was taken: from a list of stamps, or from the images' names."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taichi_mrf.calibration import board_images, depth_files
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import read_text

SUFFIXES = (*board_images.FORMATS, *depth_files.FORMATS)
"""Ends of a file's name that are no part of the image's."""


def read_stamps(path: Path) -> dict[str, float]:
    """The stamps of images: lines of ``stamp file``, as in TUM RGB-D; name without suffix -> seconds.

    Raises DatasetError naming the file and the line.
    """
    lines = read_text(path, DatasetError).splitlines()
    stamps = {}
    for number, line in enumerate(lines, start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            stamp = float(words[0])
            if len(words) != 2 or not np.isfinite(stamp):
                raise ValueError
        except ValueError:
            raise DatasetError(
                f"{path} line {number}: expected a stamp in seconds and a file's name"
            ) from None
        stamps[Path(words[1]).stem if Path(words[1]).suffix in SUFFIXES else words[1]] = stamp
    if not stamps:
        raise DatasetError(f"{path}: contains no stamp")
    return stamps


def stamps_of(names: Sequence[str], file: Path | None) -> dict[str, float]:
    """The stamp of each image by its name: from a file, else the name itself, in seconds.

    Raises DatasetError for a name that has none.
    """
    if file is not None:
        known = read_stamps(file)
        missing = [name for name in names if name not in known]
        if missing:
            raise DatasetError(f"{file}: has no stamp for {missing[0]}")
        return {name: known[name] for name in names}
    stamps = {}
    for name in names:
        try:
            stamps[name] = float(name)
        except ValueError:
            raise DatasetError(
                f"image {name}: its name is not a stamp in seconds; pass --stamps FILE"
            ) from None
    return stamps
