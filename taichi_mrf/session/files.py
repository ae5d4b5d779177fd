"""The names of the files in a run's folder, and whether a folder holds a run. Quick to import."""

import shutil
from pathlib import Path

MAP_FILE, VOXEL_FILE, CONFIG_FILE = "map.npz", "voxels.ply", "config.yaml"
MESH_FILE, NOISE_FILE = "mesh.ply", "sensor.yaml"
REPORT_FILE, TRAJECTORY_FILE = "report.json", "trajectory.txt"
WINDOW_FOLDER = "map_window.zarr"
"""The map in chunks of a run with a window (methods.mrf.parked_chunks.folder_beside)."""

PICTURE_FILES = ("surface.png", "perspective.png", "top_view.png", "depth.png")


def holds_run(folder: Path) -> bool:
    """True if a folder holds files of a run, complete or not."""
    return any((folder / name).exists() for name in (MAP_FILE, VOXEL_FILE, CONFIG_FILE, REPORT_FILE))


def remove_files_of_earlier_run(folder: Path, written: list[Path]) -> None:
    """Remove the voxels, pictures, trajectory, learnt noise and map in chunks that the present run has not
    ``written``: they show a run that it replaced."""
    if folder / WINDOW_FOLDER not in written:
        shutil.rmtree(folder / WINDOW_FOLDER, ignore_errors=True)
    for name in (VOXEL_FILE, *PICTURE_FILES, TRAJECTORY_FILE, NOISE_FILE):
        if folder / name not in written:
            (folder / name).unlink(missing_ok=True)
