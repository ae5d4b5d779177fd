"""The files that a live run leaves: the map, its voxels, its parameters."""

import tempfile
from pathlib import Path
from typing import Literal

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.export.trajectory import write_trajectory
from taichi_mrf.mapping.tracking import Track
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system.atomic import write_text

MAP_FILE, VOXEL_FILE, CONFIG_FILE = "map.npz", "voxels.ply", "config.yaml"
TRAJECTORY_FILE = "trajectory.txt"

FileKind = Literal["map", "ply"]


def write_file(kind: FileKind, m: OccupancyMap, folder: Path) -> Path:
    """Write one of the files to a folder that exists. Raises MapFileError."""
    if kind == "map":
        m.save(folder / MAP_FILE)
        return folder / MAP_FILE
    centres, probability = m.voxels(min_probability=0.5)
    write_voxels(folder / VOXEL_FILE, centres, probability, m.voxel_size)
    return folder / VOXEL_FILE


def file_content(kind: FileKind, m: OccupancyMap, out: Path | None) -> tuple[str, bytes]:
    """Name and content of one of the files, which is also left in the run's folder if it has one.

    Raises MapFileError.
    """
    with tempfile.TemporaryDirectory() as temporary:
        path = write_file(kind, m, out or Path(temporary))
        return path.name, path.read_bytes()


def write_all(m: OccupancyMap, config: Config, folder: Path, track: Track | None = None) -> list[Path]:
    """Write all files of a run: the map first, it is what the time went into. Raises MapFileError."""
    written = [write_file("map", m, folder)]
    write_text(folder / CONFIG_FILE, commented_yaml(config))
    written += [write_file("ply", m, folder), folder / CONFIG_FILE]
    if track is not None:
        write_trajectory(folder / TRAJECTORY_FILE, track.trajectory(m))
        written.append(folder / TRAJECTORY_FILE)
    return written
