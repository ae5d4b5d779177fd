"""Hints for data that no reader supports: laser scans, clouds without poses, meshes, maps, films, archives,
colours without depth, a text for each image."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taichi_mrf.datasets.images import holds_depth
from taichi_mrf.datasets.laser.readers import holds_scans
from taichi_mrf.datasets.lidar.clouds import is_cloud, read_ply_header
from taichi_mrf.datasets.trajectories import is_trajectory, read_trajectory
from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import is_file, is_folder, read_text
from taichi_mrf.system.npz_file import open_npz

_MESHES = (".ply", ".obj", ".stl", ".glb", ".off")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
ONE_FILE = (
    "write them into poses.txt in this folder, for each image a line of the 12 numbers of the first three "
    "rows of T_world_camera"
)
LIDAR_POSES = (
    "contains lidar point clouds without poses; scans are read from a folder with one .npz, .ply, .pcd, .las "
    "or .bin for each and poses.npz or a file of poses beside them, KITTI's from velodyne/ with calib.txt "
    "and poses.txt"
)
_POSE_TEXTS = (".txt", ".pose", ".cam", ".info", ".json")

AS_NPZ = (
    "write them as an .npz with depth_m (N, H, W) in metres, T_world_camera (N, 4, 4) and K (3, 3), or as "
    "16-bit PNGs NNNN.png with camera.txt (width height fx fy cx cy) and poses.txt (for each image the 12 "
    "numbers of the first three rows of T_world_camera)"
)
_BY_ENDING = {
    **dict.fromkeys((".las", ".laz", ".bin", ".velodyne"), LIDAR_POSES),
    **dict.fromkeys(
        (".xyz", ".pts", ".asc", ".ptx", ".e57"),
        "is a point cloud in an unsupported format; convert each scan to a .ply or .pcd of its own, and "
        "put a file of the sensor's poses beside them",
    ),
    **dict.fromkeys(
        (".lvx", ".lvx2", ".zbf", ".fls", ".vpcap"),
        "is a scanner maker's own format, which is unsupported; convert it to a ROS bag with PointCloud2 and "
        "poses, or each scan to a .ply or .pcd of its own with a file of the sensor's poses beside them",
    ),
    **dict.fromkeys(
        (".bt", ".ot"), "contains an OctoMap ({name}), not depth images; taichi-mrf import reads it"
    ),
    **dict.fromkeys(
        (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".zstd", ".7z", ".rar"),
        "is an archive; unpack it, and pass the folder or the file in it",
    ),
    **dict.fromkeys(
        (".mp4", ".mov", ".avi", ".webm", ".m4v"),
        "is a video: it has colours, but a map needs depth; pass the folder of the recording with "
        "its depth images",
    ),
    **dict.fromkeys(
        (".mkv", ".svo", ".svo2", ".oni", ".klg", ".rrd"),
        "is a camera maker's own format, which is unsupported; record or convert it to a ROS bag with depth, "
        "camera_info and poses, or " + AS_NPZ,
    ),
    **dict.fromkeys(
        (".hdf5", ".h5", ".mat", ".npy", ".pkl", ".pt", ".exr", ".pfm", ".raw"),
        "holds arrays or images in an unsupported format ({name}); " + AS_NPZ,
    ),
    **dict.fromkeys(
        (".fbx", ".dae", ".gltf", ".usd", ".usdz", ".x3d"),
        "contains a mesh ({name}), not depth images; converted to .ply or .glb, 'mesh:FILE?poses=FILE' "
        "renders depth images of it",
    ),
    ".active": "was not closed by its recorder; 'rosbag reindex' repairs it, then name it .bag",
    ".sens": "is ScanNet's packed format; extract it to depth/, pose/ and intrinsic/ with ScanNet's tools",
}
_SAVED_MAP = "is a saved map, not a recording"
_POSES_ONLY = "and no depth images"
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm")
_LOOKED_AT = 20


def hint_for(path: Path) -> str | None:
    """A sentence on what a file, or most of a folder, holds in place of depth images, and on the command that
    reads it; None if it is unknown."""
    if holds_scans(path):
        return (
            "contains scans of a 2D laser scanner, not depth images; map them with: "
            f"taichi-mrf laser {shlex.quote(str(path))} --out DIR"
        )
    if path.suffix == ".zarr" and is_folder(path):
        return f"{_SAVED_MAP}: taichi-mrf info, export and diff read it, and live shows the map.npz of a run"
    if is_folder(path / "oxts"):
        return (
            "is a raw recording of KITTI's, whose oxts/ holds latitudes and angles: write the sensor's poses "
            "as rows of 12 numbers into poses.txt (pykitti computes them), beside a folder with the scans"
        )
    if is_folder(path / "rtabmap_depth"):
        return (
            "is output of rtabmap-export; pass the database itself (rtabmap.db), which has the poses, "
            "the cameras and where they are mounted"
        )
    if not is_folder(path):
        return image_hint([path], "is one image") if path.suffix.lower() in _IMAGES else _kind(path)
    if is_file(path / "map.npz"):
        return _kind(path / "map.npz")
    children = [child for child in sorted(path.iterdir()) if is_file(child)]
    scans = [child for child in children if holds_scans(child)]
    if scans:
        names = ", ".join(child.name for child in scans[:8])
        return f"contains 2D laser scans; pass one of {names} to taichi-mrf laser"
    kinds = [kind for child in children if (kind := _kind(child))]
    looked_at = children[:_LOOKED_AT]
    for folder in filter(is_folder, sorted(path.iterdir())):
        looked_at += [file for file in sorted(folder.iterdir()) if is_file(file)][:_LOOKED_AT]
    images = [file for file in looked_at if file.suffix.lower() in _IMAGES]
    unread = [file for file in looked_at if file.suffix.lower() in (".exr", ".npy", ".pfm")]
    most = kinds[0] if len(set(kinds)) == 1 and 2 * len(kinds) >= len(children) else None
    if most and not ((images or unread) and _POSES_ONLY in most):
        return most
    if unread:
        return _kind(unread[0])
    return image_hint(images, "holds images") if images else None


def image_hint(images: Sequence[Path], what: str) -> str:
    """Hint on what is missing for images, of which some are looked at, to be a recording."""
    depth = next((path for path in images if holds_depth(path)), None)
    if depth is None:
        return (
            f"{what} ({images[0].name}), but no depth image (16-bit grey, or floats): a map is made of "
            "depth, which colours do not tell; pass the folder that has the depth images too"
        )
    return (
        f"{what} of depth ({depth.name}) in an unsupported layout: a recording is a folder with all of "
        f"them, their poses and their camera; {AS_NPZ}"
    )


def _kind(path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix == ".ply" and _is_cloud(path):
        return LIDAR_POSES
    if suffix in _MESHES:
        return (
            f"contains a mesh or points ({path.name}), not depth images; "
            f"'mesh:{path}?poses=FILE' renders depth images of a mesh; a lidar's scans need poses beside them"
        )
    if suffix in (".txt", ".csv", ".json", ".log", ".tum", ".freiburg") and is_trajectory(path):
        return (
            f"contains poses ({path.name}) {_POSES_ONLY}; pass the recording that they are of, with "
            f"--poses {shlex.quote(str(path))}"
        )
    if suffix == ".npz":
        return LIDAR_POSES if is_cloud(path) else _other_arrays(path)
    found = _BY_ENDING.get(suffix)
    return found and found.replace("{name}", path.name)


def _other_arrays(path: Path) -> str | None:
    try:
        with open_npz(path, DatasetError, "a readable npz file") as file:
            held = ", ".join(file.names[:8]) or "nothing"
            if {"format", "keyframe_ids"} <= set(file.names):
                return f"{_SAVED_MAP}: taichi-mrf live, export, info and diff read {path.name}"
    except DatasetError:
        return None
    return f"contains {held}, but not depth_m, T_world_camera and K of frames, nor xyz of a scan"


def _is_cloud(path: Path) -> bool:
    try:
        return read_ply_header(path).faces == 0
    except DatasetError:
        return False


def pose_files_hint(folder: Path, images: Sequence[Path], remedy: str = ONE_FILE) -> str | None:
    """Hint for reading a recording with poses, and perhaps intrinsics, in a text file for each image; None
    if there are no such files. ``remedy`` says where the reader expects the poses."""
    places = [folder, *(child for child in sorted(folder.iterdir()) if is_folder(child))]
    for place in places:
        texts = [
            p for p in sorted(place.iterdir()) if p.suffix in _POSE_TEXTS and any(map(str.isdigit, p.stem))
        ]
        if len(texts) > 1 and 2 * len(texts) >= len(images):
            return _pose_file_hint(texts, remedy)
    return None


def _pose_file_hint(texts: Sequence[Path], remedy: str) -> str | None:
    """The hint, if the first file looks like the numbers of one frame."""
    if texts[0].suffix == ".json":
        return (
            f"{len(texts)} files such as {texts[0].name} may hold the pose and the camera of one image each, "
            f"in an unsupported layout: {remedy}, and pass --camera fx,fy,cx,cy and --depth-scale (1000 "
            "for millimetres). Poses of ARKit (Polycam, 3D Scanner App) want --poses-are opengl"
        )
    try:
        text = read_text(texts[0], DatasetError)
    except DatasetError:
        return None
    rows = [[float(word) for word in _NUMBER.findall(line)] for line in text.splitlines()]
    counts = [len(row) for row in rows]
    flat = [number for row in rows for number in row]
    camera = next((rows[i : i + 3] for i in range(len(rows)) if counts[i : i + 3] == [3, 3, 3]), None)
    flags = "--camera fx,fy,cx,cy"
    if camera is not None:
        K = np.array(camera)
        flags = f"--camera {K[0, 0]:g},{K[1, 1]:g},{K[0, 2]:g},{K[1, 2]:g}"
    if camera is None and len(flat) not in (7, 8, 12, 16, 21, 25):
        return None
    return (
        f"{len(texts)} text files such as {texts[0].name} hold one pose each, in an unsupported layout: "
        f"{remedy}, and pass {flags} and --depth-scale (1000 for millimetres)"
    )


def unread_poses(folder: Path) -> str:
    """Problem of a text file whose name says that it holds poses, in words."""
    if is_file(folder / "transforms.json"):
        return (
            ". transforms.json, as nerfstudio has it, is read if its frames have a depth_file_path; else "
            "write its transform_matrix, row by row, into poses.txt, and pass --poses-are opengl and "
            "--camera fl_x,fl_y,cx,cy"
        )
    for path in sorted([*folder.glob("*.txt"), *folder.glob("*.csv")]):
        if re.search("pose|traj|groundtruth", path.name, re.IGNORECASE):
            try:
                read_trajectory(path)
            except DatasetError as error:
                return f". {error}"
            if not is_trajectory(path):
                return f". {path}: seven numbers, the last four no quaternion; angles are not read"
    return ""
