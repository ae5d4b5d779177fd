"""Recognition of bags by the names of files and folders."""

import re
from pathlib import Path

from taichi_mrf.system.files import is_file, is_folder

SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"
"""A folder with this file is a ROS 2 bag."""

_NUMBERED = re.compile(r"(.*?)(?:\d{4}(?:-\d\d){5})?_(\d+)")
"""The name of a file of a recording that was split while it ran: a beginning, for ROS 1 the time at which it
was opened, and its number."""


def is_bag(path: Path) -> bool:
    """True if a path looks like a bag: a file by its name, a folder by its metadata or its split files."""
    return path.suffix in SUFFIXES if is_file(path) else is_file(path / METADATA) or bool(parts_of(path))


def parts_of(path: Path) -> list[Path]:
    """The files of a recording that was split, NAME_0.bag, NAME_1.bag, ..., in a folder without metadata, in
    their order; none for any other path."""
    if not is_folder(path) or is_file(path / METADATA):
        return []
    files = [file for file in path.iterdir() if file.suffix in SUFFIXES]
    found = {file: _NUMBERED.fullmatch(file.stem) for file in files}
    parts = {int(match[2]): file for file, match in found.items() if match is not None}
    kinds = {(match[1], file.suffix) for file, match in found.items() if match is not None}
    numbers = sorted(parts)  # a recorder with little space deletes the first files
    follow = numbers[-1:] == [number + len(files) - 1 for number in numbers[:1]]
    is_one = len(kinds) == 1 and len(files) == len(parts) > 1 and follow
    return [parts[number] for number in numbers] if is_one else []
