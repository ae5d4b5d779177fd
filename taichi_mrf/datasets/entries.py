"""The formats and the built-in sources that come with the package, and what tells that a source is one.

A format's reader is a module that is named here and imported when a source of that format is opened. The
first entry that recognises a folder or a file opens it, even if some of its files are missing or damaged:
opening reports them. Formats of other packages, and those that few have, are plugs (registry.py).
"""

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taichi_mrf.datasets.base import BuiltIn, Format, when_called
from taichi_mrf.datasets.ros.names import METADATA, SUFFIXES, is_bag
from taichi_mrf.system.files import is_file, is_folder

REALSENSE = "realsense:"
FOXGLOVE, ZENOH = ROBOTS = "foxglove:", "zenoh:"
NUMBERED_IMAGE = re.compile(
    r"(depth[-_]?|(?:frame|image|img)[-_]?)?(\d+)(-\d+)?\.(?:png|tiff?)", re.IGNORECASE
)
"""The name of an image: a number, perhaps behind a word. Redwood's own scans append microseconds."""

_STAMPED_IMAGE = re.compile(r"(\d+\.\d+)\.(?:png|tiff?)", re.IGNORECASE)

NUMBERED_FILES = "NNNN.png (here or in depth/) and a trajectory (.log, .json, .freiburg or rows of matrices)"

CLOUDS = (".npz", ".ply", ".pcd", ".bin", ".las", ".laz")
CLOUD_PLACES = ("", "scans", "clouds", "lidar", "velodyne", "pcd", "ply", "las")
"""Places of clouds in a folder."""

YAML = (".yaml", ".yml")


def numbered_images(folder: Path) -> dict[int, Path]:
    """Number -> image, ascending, of those in depth/ or in the folder itself."""
    for place in (folder / "depth", folder):
        if place.is_dir():
            found = [(m, path) for path in place.iterdir() if (m := NUMBERED_IMAGE.fullmatch(path.name))]
            kinds = {(match[1] or "")[:1].lower() for match, _ in found}
            if place == folder:  # where images of other names are colours
                kinds &= {"", "d"}
            if kinds:
                kind = next(each for each in ("d", "", *sorted(kinds)) if each in kinds)
                return dict(
                    sorted((int(m[2]), path) for m, path in found if (m[1] or "")[:1].lower() == kind)
                )
    return {}


def stamped_images(folder: Path) -> list[tuple[float, Path]]:
    """The images in depth/ that are called by their stamps in seconds, ascending, beside TUM's poses."""
    if not (is_folder(folder / "depth") and is_file(folder / "groundtruth.txt")):
        return []
    found = [(_STAMPED_IMAGE.fullmatch(path.name), path) for path in (folder / "depth").iterdir()]
    return sorted((float(match[1]), path) for match, path in found if match)


def velodyne_sequence(path: Path) -> Path | None:
    """The folder of a KITTI sequence, from its own path or that of its scans in velodyne/."""
    if not is_folder(path):
        return None
    return path.parent if path.name == "velodyne" and not is_folder(path / "velodyne") else path


def holds_frames(path: Path) -> bool:
    """True if an npz file, or the first of a folder, holds frames, and not a map or something else."""
    if is_folder(path):
        path = next(iter(sorted(path.glob("*.npz"))), path)
    if path.suffix != ".npz" or not is_file(path):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return {"depth_m.npy", "T_world_camera.npy"} & set(archive.namelist()) != set()
    except Exception:  # zipfile's parser raises many kinds; opening the file names the problem
        return True


def _has(*names: str) -> Callable[[Path], bool]:
    """True if a folder has these files, and, by names that end in a slash, these folders."""
    return lambda folder: all(
        is_folder(folder / name) if name.endswith("/") else is_file(folder / name) for name in names
    )


def _has_named(pattern: str, below: str = "") -> Callable[[Path], bool]:
    """True if a folder, or one ``below`` it, has something whose whole name fits a pattern."""
    name = re.compile(pattern)
    return lambda folder: (
        is_folder(folder / below) and any(name.fullmatch(path.name) for path in (folder / below).iterdir())
    )


def _is_velodyne(path: Path) -> bool:
    folder = velodyne_sequence(path)
    return folder is not None and is_file(folder / "calib.txt") and _has_named(r".*\.bin", "velodyne")(folder)


def _is_scan_folder(path: Path) -> bool:
    """Answer of its reader, which looks into files: it is asked where there are any that may be clouds."""
    if is_file(path):
        return path.suffix.lower() == ".pcd"
    places = (path / place for place in CLOUD_PLACES)
    may_be = any(c.suffix.lower() in CLOUDS for place in places if is_folder(place) for c in place.iterdir())
    return may_be and reader("lidar.scan_folder:recognises")(path)


def reader(place: str) -> Callable[..., Any]:
    """Opener of a source, "module:function" in this package, which is imported when it is called."""
    return when_called(f"taichi_mrf.datasets.{place}")


FORMATS: tuple[Format, ...] = (
    Format(
        "7-Scenes",
        "frame-NNNNNN.depth.png and frame-NNNNNN.pose.txt",
        _has_named(r"frame-\d+\.(depth\.png|pose\.txt)"),
        reader("formats.seven_scenes:open_folder"),
    ),
    Format(
        "TUM RGB-D",
        "depth.txt and groundtruth.txt",
        lambda path: _has("depth.txt")(path) or bool(stamped_images(path)),
        reader("formats.tum_rgbd:open_folder"),
    ),
    Format(
        "ScanNet",
        "depth/N.png and pose/N.txt",
        _has("depth/", "pose/"),
        reader("formats.scannet:open_folder"),
    ),
    Format(
        "Replica (NICE-SLAM)",
        "results/depthNNNNNN.png and traj.txt",
        _has_named(r"depth\d+\.png", "results"),
        reader("formats.replica:open_folder"),
    ),
    Format(
        "nerfstudio",
        "transforms.json with depth_file_path",
        lambda path: _has("transforms.json")(path) and reader("formats.nerfstudio:recognises")(path),
        reader("formats.nerfstudio:open_folder"),
    ),
    Format(
        "ICL-NUIM / Redwood",
        NUMBERED_FILES,
        lambda path: bool(numbered_images(path)),
        reader("formats.numbered_depth:open_folder"),
    ),
    Format(
        "KITTI stereo",
        "image_l and image_r (or image_0 and image_1) with calib.txt and poses.txt",
        lambda path: _has("image_l/", "image_r/")(path) or _has("image_0/", "image_1/")(path),
        reader("formats.kitti:open_pairs"),
    ),
    Format(
        "ROS bag",
        f"{', '.join(SUFFIXES)} or the folder of a ROS 2 bag with {METADATA}, or of a split one",
        is_bag,
        reader("ros.bag:open_bag"),
        takes_query=True,
    ),
    Format(
        "KITTI velodyne",
        "velodyne/NNNNNN.bin with calib.txt and poses.txt",
        _is_velodyne,
        reader("formats.kitti:open_scans"),
    ),
    Format(
        "lidar scans",
        "scan-NNN.npz (xyz), *.ply, *.pcd, *.las or *.bin with poses.npz or a file of poses; "
        "*.pcd with VIEWPOINT",
        _is_scan_folder,
        reader("lidar.scan_folder:open_folder"),
        takes_query=True,
    ),
    Format(
        "npz",
        "*.npz with depth_m, T_world_camera and K",
        holds_frames,
        reader("formats.frames_npz:open_npz_frames"),
    ),
    Format(
        "stereo pairs",
        ".yaml that describes stereo pairs",
        lambda path: path.suffix in YAML and is_file(path),
        reader("stereo.rig_file:open_file"),
    ),
)

BUILT_IN: dict[str, BuiltIn] = {
    each.name: each
    for each in (
        BuiltIn("synthetic:room", reader("synthetic.room:open_synthetic_room"), rendered=True),
        BuiltIn("synthetic:corridor", reader("synthetic.corridor:open_synthetic_corridor"), rendered=True),
        BuiltIn("synthetic:ring", reader("synthetic.corridor:open_synthetic_ring"), rendered=True),
        BuiltIn("mesh:", reader("synthetic.mesh_scene:open_mesh")),
        BuiltIn(REALSENSE, reader("realsense.device:open_realsense")),
        BuiltIn(FOXGLOVE, reader("wires.robot:open_foxglove")),
        BuiltIn(ZENOH, reader("wires.robot:open_zenoh")),
    )
}
