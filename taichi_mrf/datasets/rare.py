"""Formats that few have: plugs (registry.py) of this package, declared in pyproject.toml as another's would
be.

What tells that a source is one is here; the readers are imported when such a source is opened.
"""

from pathlib import Path

from taichi_mrf.config.files import read_yaml
from taichi_mrf.datasets.base import Format
from taichi_mrf.datasets.entries import reader
from taichi_mrf.errors import ConfigError
from taichi_mrf.system.files import is_file, is_folder


def _lists_sensors(path: Path) -> bool:
    """True if a YAML file has an entry ``sensors``."""
    if path.suffix not in (".yaml", ".yml") or not is_file(path):
        return False
    try:
        values = read_yaml(path)
    except ConfigError:
        return False
    return isinstance(values, dict) and "sensors" in values


def _is_stray_scanner(path: Path) -> bool:
    texts = path / "camera_matrix.csv", path / "odometry.csv"
    return is_folder(path / "depth") and all(map(is_file, texts))


def _is_record3d(path: Path) -> bool:
    """True if a file ends in .r3d, or a folder holds what is in one."""
    if is_file(path):
        return path.suffix.lower() == ".r3d"
    return is_file(path / "metadata") and is_folder(path / "rgbd")


SEVERAL_SENSORS = Format(
    "several sensors",
    "a .yaml file with a list of sensors",
    _lists_sensors,
    reader("several_sensors:open_file"),
)
STRAY_SCANNER = Format(
    "Stray Scanner",
    "depth/NNNNNN.png with camera_matrix.csv and odometry.csv",
    _is_stray_scanner,
    reader("formats.stray_scanner:open_folder"),
)
RECORD3D = Format(
    "Record3D",
    "*.r3d, or a folder with metadata and rgbd/N.depth",
    _is_record3d,
    reader("formats.record3d:open_recording"),
)
LAS = Format(
    "LAS survey",
    "*.las or *.laz, with the file of the lidar's poses",
    lambda path: path.suffix.lower() in (".las", ".laz") and is_file(path),
    reader("lidar.las_file:open_survey"),
    takes_query=True,
)
OUSTER = Format(
    "Ouster",
    "*.osf, or *.pcap with its .json",
    lambda path: path.suffix.lower() in (".osf", ".pcap") and is_file(path),
    reader("lidar.ouster:open_recording"),
    takes_query=True,
)
RTABMAP = Format(
    "RTAB-Map",
    "a database (.db)",
    lambda path: path.suffix == ".db" and is_file(path),
    reader("formats.rtabmap:open_database"),
)
