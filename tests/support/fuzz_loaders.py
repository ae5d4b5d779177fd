"""Everything that reads a file, with a good input to damage.

A loader's ``read`` gives all that is in the input as bytes, so that what was read of a damaged one can be
told from what was there before.
"""

import gzip
import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from bag_clouds import write as write_clouds
from datasets_recordings import (
    CAMERA,
    INTRINSIC,
    Content,
    arrays,
    column_by_column,
    stamped_line,
    write_image,
    write_npz,
    write_numbered,
    write_record3d,
    write_seven_scenes,
)
from every_format import EVERY
from inputs_bags import Bag, plain, write_bag
from laser_logs import ODOMETRY, flaser, robotlaser
from laser_logs import write_npz as write_scans
from point_clouds import Walk, write_pcd, write_velodyne
from point_clouds import write_ply as write_cloud_ply
from point_clouds import write_scans as write_lidar_scans
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from stereo_rig import write as write_stereo_file
from stereo_rig import write_kitti

from taichi_mrf.calibration.pairs import DepthFiles
from taichi_mrf.calibration.truth_sources import read_stamps
from taichi_mrf.config.schema import Config, VolumeConfig, load
from taichi_mrf.config.text import commented_yaml
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.formats.frames_npz import FramesNpz
from taichi_mrf.datasets.formats.rtabmap import RtabmapRecording
from taichi_mrf.datasets.images import read_grey
from taichi_mrf.datasets.laser.readers import open_scans
from taichi_mrf.datasets.laser.scans import read_floor_plan
from taichi_mrf.datasets.pose_sources.graph_file import read_pose_graph
from taichi_mrf.datasets.synthetic.mesh_scene import load_mesh
from taichi_mrf.datasets.timed_poses import read_timed_poses
from taichi_mrf.errors import FrameError, TaichiMRFError
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.octomap import write_bt, write_ot
from taichi_mrf.export.octomap_reader import read_octomap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.parked_chunk import chunk_of, read_parked
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PatchNoise, noise_from_config
from taichi_mrf.system.atomic import write_npz as write_arrays

WALK = Walk(points=12)
CONTENT = Content(2)


class FramesRefusedError(TaichiMRFError):
    """Some frames are broken and named, the others could be read."""


@dataclass(frozen=True)
class Loader:
    """``make`` writes a good input into an empty folder and returns what ``read`` is to be given; ``sealed``
    says that the format has checksums, so that damaged bytes must not read as something else."""

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], bytes]
    sealed: bool = False


def frames_of(dataset: Dataset) -> bytes:
    """All frames of a recording, each of which must be sound, or refused by its name."""
    found, refused = [], []
    for index, name in enumerate(dataset.frame_names):
        try:
            frame = dataset.read(index)
        except FrameError as error:
            refused.append((name, str(error)))
            continue
        assert frame.depth_m.shape == frame.camera.shape
        own_cameras = isinstance(dataset, RtabmapRecording | FramesNpz)
        if isinstance(frame.camera, PinholeCamera) and not frame.sensor and not own_cameras:
            assert frame.camera == dataset.camera
        assert frame.depth_m.dtype == np.float32
        assert np.isfinite(frame.depth_m).all()
        assert (frame.depth_m >= 0).all()
        assert frame.T_world_camera.shape == (4, 4)
        assert np.isfinite(frame.T_world_camera).all()
        parts = (
            frame.depth_m.tobytes(),
            frame.T_world_camera.tobytes(),
            frame.stamp,
            name,
            repr(frame.camera),
        )
        images = (frame.color, frame.sigma_m, frame.no_return)
        found.append((*parts, *(None if image is None else image.tobytes() for image in images)))
    assert all(f"frame {name}: " in said for name, said in refused)
    if refused:
        raise FramesRefusedError(refused[0][1])
    return pickle.dumps((repr(dataset.camera), dataset.dropped, found))


def mapped(dataset: Dataset) -> None:
    """Put whatever could be read of a damaged recording into a map: it is one, or is refused."""
    m = MRFMap(0.25, max_depth=6.0)
    for index in range(min(2, len(dataset))):
        try:
            frame = dataset.read(index)
            m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
        except TaichiMRFError:
            continue
    _answers(m)


def _answers(m: OccupancyMap) -> None:
    """A map's account of itself is sound."""
    m.infer(sweeps=1)
    centres, p = m.voxels(0.0)
    assert np.isfinite(centres).all()
    assert ((p >= 0) & (p <= 1)).all()
    assert np.isfinite(m.occupancy(centres[:100])).all()


_last: list[Dataset] = []
"""The recording that was read last."""


def _dataset(path: Path) -> bytes:
    dataset = open_dataset(path)
    content = frames_of(dataset)
    _last[:] = [dataset]
    return content


def map_last_dataset() -> None:
    """Map what was read last, if it was a recording."""
    while _last:
        mapped(_last.pop())


def _map(path: Path) -> bytes:
    """The map as it would be saved again."""
    m = load_map(path)
    again = path.with_name(".again.npz")
    m.save(again)
    content = again.read_bytes()
    again.unlink()
    if content != path.read_bytes():
        _answers(m)
    return content


def _chunks(path: Path) -> bytes:
    m = ChunkedMap.open(path)
    centres, p = m.voxels(min_probability=0.0)
    assert np.isfinite(centres).all()
    assert ((p >= 0) & (p <= 1)).all()
    return pickle.dumps((m.header, m.chunks, centres, p))


def _octomap(path: Path) -> bytes:
    leaves = read_octomap(path)
    bricks, log_odds = leaves.bricks()
    assert np.isfinite(log_odds).all()
    return pickle.dumps((leaves.voxel_size, bricks, log_odds))


def _config(path: Path) -> bytes:
    config = load(path)
    noise = noise_from_config(config.sensor, CAMERA)
    assert np.isfinite(noise.table(CAMERA).coefficients).all()
    return commented_yaml(config).encode() + noise.table(CAMERA).coefficients.tobytes()


def _pose_graph(path: Path) -> bytes:
    graph = read_pose_graph(path)
    edges = [(e.first, e.second, e.T_first_second, e.information) for e in graph.edges]
    assert all(np.isfinite(T).all() for T in graph.poses.values())
    return pickle.dumps((dict(graph.poses), edges))


def _depth_images(path: Path) -> bytes:
    files = DepthFiles(path, 1000.0)
    return pickle.dumps([(name, files.read(name)) for name in files.names])


def _parked(path: Path) -> bytes:
    chunk = chunk_of(path.name)
    assert chunk is not None
    found = read_parked(path, chunk, 0.2)
    return pickle.dumps([getattr(found, field.name) for field in fields(found)])


def _parts(open_file: Callable[[Path], object], *names: str, finite: str = "") -> Callable[[Path], bytes]:
    """Reads a file and takes some parts of what it holds, those in ``finite`` with finite numbers only."""

    def read(path: Path) -> bytes:
        whole = open_file(path)
        assert all(np.isfinite(getattr(whole, name)).all() for name in finite.split())
        return pickle.dumps([getattr(whole, name) for name in (*names, *finite.split())])

    return read


def _at(name: str, write: Callable[[Path], object]) -> Callable[[Path], Path]:
    """Writes a file or folder of this name, perhaps with a suffix; into the folder itself if it is empty."""

    def make(folder: Path) -> Path:
        written = write(folder / name)
        return written if isinstance(written, Path) else folder / name

    return make


def _file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    data = content.encode() if isinstance(content, str) else content
    return _at(name, lambda path: path.write_bytes(data))


def _with_camera(name: str, text: str, folder: Path) -> None:
    write_seven_scenes(folder, CONTENT)
    (folder / "camera.txt").unlink()
    (folder / name).write_text(text)


def _open3d(folder: Path) -> None:
    write_numbered(folder, CONTENT, place="depth")
    (folder / "camera.txt").unlink()
    entries = [{"extrinsic": column_by_column(p), "intrinsic": INTRINSIC} for p in CONTENT.poses]
    values = {"class_name": "PinholeCameraTrajectory", "parameters": entries}
    (folder / "trajectory.json").write_text(json.dumps(values, indent=1))


def _record3d(path: Path) -> None:
    """Packed where the library is there."""
    lzfse = import_module("lzfse") if find_spec("lzfse") else None
    write_record3d(path, CONTENT, bytes if lzfse is None else lzfse.compress)


def _npz_folder(folder: Path) -> None:
    for name in ("a", "b"):
        write_npz(folder / f"{name}.npz", arrays(CONTENT))


def _lidar_plies(folder: Path) -> None:
    for i, cloud in enumerate(WALK.clouds):
        write_cloud_ply(folder / f"{i + 0.5}.ply", cloud, ("ascii", "binary_little_endian")[i % 2])
    lines = [stamped_line(0.5 * i, WALK.poses[i // 2]) for i in range(2 * WALK.count)]
    (folder / "poses.txt").write_text("\n".join(lines))


def _pcds(encoding: str, folder: Path) -> Path:
    for i, (cloud, T) in enumerate(zip(WALK.clouds, WALK.poses, strict=True)):
        write_pcd(folder / f"{i}.pcd", cloud @ T[:3, :3].T + T[:3, 3], encoding, T)
    return folder


def _survey(path: Path) -> None:
    """Not packed: the unpacker of LAZ ends the process on some files whose packed points are damaged."""
    laspy = import_module("laspy")
    file = laspy.create(point_format=6, file_version="1.4")
    file.x, file.y, file.z = WALK.clouds[0].T
    file.gps_time = np.linspace(0.0, 0.3, len(WALK.clouds[0]))
    file.write(path)
    lines = [stamped_line(stamp, WALK.poses[0]) for stamp in (-0.05, 0.05, 0.15, 0.25, 0.35)]
    path.with_suffix(".txt").write_text("\n".join(lines))


def _several(path: Path) -> None:
    write_npz(path.with_name("walk.npz"), arrays(CONTENT))
    write_lidar_scans(path.with_name("scans"), WALK)
    text = "sensors:\n  - name: depth\n    source: walk.npz\n  - source: scans\n    sigma: [0.02, 0.001]\n"
    path.write_text(text + "    every: 2\n    max_depth: 5.0\n")


def _packed_bag(mode: CompressionMode) -> Callable[[Path], Path]:
    """A ROS 2 bag whose messages, or whose file, are compressed."""

    def write(path: Path) -> None:
        writer: Any = Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            plain(Bag("sqlite", writer))

    return _at("walk", write)


@cache
def _small_map(method: str) -> OccupancyMap:
    """Two views of a wall, of which an MRFMap has frozen one."""
    m: OccupancyMap = MRFMap(0.2, max_depth=4.0) if method == "mrf" else LogOddsMap(0.2, max_depth=4.0)
    for i in range(3):
        depth_m = np.full(CAMERA.shape, 1.5 + 0.1 * i, np.float32)
        m.add_keyframe(depth_m, np.eye(4), CAMERA, f"frame {i}")
    m.infer()
    if isinstance(m, MRFMap):
        m.freeze_keyframe(0)
        m.infer()
    return m


def _parked_chunk(folder: Path) -> Path:
    """A chunk that has left the window of a map."""
    m = MRFMap(0.2, max_depth=4.0, volume=VolumeConfig(window_m=2.0))
    assert m.window is not None
    m.window.park_in(folder / "map_window.zarr")
    T_world_camera = np.eye(4)
    for x in (0.0, 90.0):
        T_world_camera[0, 3] = x
        m.add_keyframe(np.full(CAMERA.shape, 1.5, np.float32), T_world_camera, CAMERA)
    file = max((folder / "map_window.zarr" / "parked").iterdir(), key=lambda file: file.stat().st_size)
    return Path(shutil.copy(file, folder))


def _yaml(path: Path) -> None:
    np.save(path.with_name("sigma.npy"), TABLES)
    np.save(path.with_name("bias.npy"), TABLES)
    text = commented_yaml(Config()).replace("sigma_table: null", "sigma_table: sigma.npy")
    text = text.replace("bias_table: null", "bias_table: bias.npy").replace("patch: 20", "patch: 8")
    path.write_text("\n".join(x for x in text.splitlines() if "#" not in x))


K_TXT = "14 0 7.5\n0 15 5.5\n0 0 1"
CAMERA_YAML = "width: 16\nheight: 12\nfx: 14\nfy: 15\ncx: 7.5\ncy: 5.5\n"
TABLES = np.random.default_rng(0).uniform(0.01, 0.02, (4, 3))
GREY = np.arange(48, dtype=np.uint8).reshape(6, 8)
PLAN = np.where(np.arange(30)[:, None] % 7 == 0, np.uint8(0), np.full((30, 40), 255, np.uint8))
DEPTH_M = np.stack(CONTENT.depth) / np.float32(1000)
TRIANGLE = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
CARMEN = "\n".join(
    [
        ODOMETRY,
        flaser([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]),
        ODOMETRY,
        flaser([1.5, 2, 60], [1, 2, 3]),
        "PARAM x 1",
    ]
)
ROBOTLASER = [robotlaser([1.0, 2.0, 3.0], [0.1, i, 0.3], -1.5, 1.5, 81.9, (3, 4, 5)) for i in range(2)]
GRAPH = "".join(f"VERTEX3 {i} {i} 0 1 0.1 {i} 0.2\n" for i in range(3))
GRAPH += "VERTEX_SE3:QUAT 7 1 2 3 0 0 0 1\nEDGE_SE3:QUAT 0 7 1 2 3 0 0 0 1 " + "1 " * 21 + "\n"
STREAM = "\n".join(stamped_line(0.1 * i, pose) for i, pose in enumerate(CONTENT.poses))

_scans = _parts(open_scans, "angle_rad", "hit", finite="range_m pose_x_y_theta")
_plan = _parts(lambda path: read_floor_plan(path, (4.0, 3.0)), "wall", "pixel_x_y")

LOADERS = [
    *(
        Loader(name, _at("recording", partial(write, content=CONTENT)), _dataset)
        for name, write in EVERY.items()
    ),
    Loader("7-Scenes, camera.yaml", _at("", partial(_with_camera, "camera.yaml", CAMERA_YAML)), _dataset),
    Loader("7-Scenes, intrinsics.txt", _at("", partial(_with_camera, "intrinsics.txt", K_TXT)), _dataset),
    Loader("Open3D JSON", _at("", _open3d), _dataset),
    Loader("Record3D, folder", _at("walk", _record3d), _dataset),
    Loader("frames npz", _at("walk.npz", partial(write_npz, values=arrays(CONTENT))), _dataset, sealed=True),
    Loader("frames npz, folder", _at("", _npz_folder), _dataset, sealed=True),
    Loader("KITTI stereo", write_kitti, _dataset),
    Loader("several sensors", _at("robot.yaml", _several), _dataset),
    Loader("stereo YAML", partial(write_stereo_file, names=["a", "b", "c"]), _dataset),
    Loader("lidar npz", partial(write_lidar_scans, walk=WALK), _dataset, sealed=True),
    Loader("lidar PLY", _at("", _lidar_plies), _dataset),
    *(
        Loader(f"PCD {each}", partial(_pcds, each), _dataset)
        for each in ("ascii", "binary", "binary_compressed")
    ),
    Loader("KITTI velodyne", lambda folder: write_velodyne(folder / "walk", WALK, WALK.poses[2]), _dataset),
    *([Loader("LAS survey", _at("walk.las", _survey), _dataset)] if find_spec("laspy") else []),
    Loader("ROS 1 bag", lambda folder: write_bag(folder, plain, kind="ros1"), _dataset),
    Loader("ROS 2 bag, sqlite", lambda folder: write_bag(folder, plain, kind="sqlite"), _dataset),
    Loader("MCAP", lambda folder: write_bag(folder, plain, kind="mcap"), _dataset),
    Loader("ROS 2 bag, clouds", partial(write_clouds, kind="sqlite"), _dataset),
    Loader("ROS 2 bag, packed messages", _packed_bag(CompressionMode.MESSAGE), _dataset),
    Loader("ROS 2 bag, packed file", _packed_bag(CompressionMode.FILE), _dataset),
    *(
        Loader(
            f"image {suffix}",
            _at(f"image{suffix}", partial(write_image, image=GREY)),
            lambda path: read_grey(path).tobytes(),
        )
        for suffix in (".jpg", ".tiff", ".webp", ".bmp", ".pgm")
    ),
    Loader("CARMEN log", _file("walk.log", CARMEN), _scans),
    Loader("CARMEN log, ROBOTLASER1", _file("walk.log", "\n".join(ROBOTLASER)), _scans),
    Loader("CARMEN log, gzip", _file("walk.log.gz", gzip.compress(CARMEN.encode())), _scans, sealed=True),
    Loader("scans npz", _at("scans.npz", write_scans), _scans, sealed=True),
    Loader("floor plan", _at("plan.png", partial(write_image, image=PLAN)), _plan),
    Loader("map, MRFMap", _at("map.npz", lambda path: _small_map("mrf").save(path)), _map, sealed=True),
    Loader(
        "map, LogOddsMap", _at("map.npz", lambda path: _small_map("log_odds").save(path)), _map, sealed=True
    ),
    *(
        [
            Loader(
                "map in chunks", _at("map.zarr", lambda path: export_map(_small_map("mrf"), path)), _chunks
            ),
            Loader("chunk outside the window", _parked_chunk, _parked, sealed=True),
        ]
        if find_spec("zarr")
        else []
    ),
    Loader("OctoMap .ot", _at("map.ot", lambda path: write_ot(path, _small_map("log_odds"))), _octomap),
    Loader("OctoMap .bt", _at("map.bt", lambda path: write_bt(path, _small_map("log_odds"))), _octomap),
    Loader("configuration YAML", _at("my.yaml", _yaml), _config),
    Loader(
        "noise.npz",
        _at("noise.npz", lambda path: write_arrays(path, PatchNoise(TABLES, TABLES, 8, CAMERA).arrays())),
        _parts(PatchNoise.load, "sigma", "bias", "patch", "camera"),
        sealed=True,
    ),
    Loader("pose stream", _file("poses.txt", STREAM), _parts(read_timed_poses, "stamps", "poses")),
    Loader("pose graph", _file("graph.g2o", GRAPH), _pose_graph),
    Loader(
        "stamps",
        _file("stamps.txt", "0.5 a.png\n1.5 b.png\n"),
        lambda path: pickle.dumps(read_stamps(path)),
    ),
    Loader("depth stack npy", _at("stack.npy", lambda path: np.save(path, DEPTH_M)), _depth_images),
    Loader(
        "depth stack npz", _at("stack.npz", partial(np.savez, depth_m=DEPTH_M)), _depth_images, sealed=True
    ),
    Loader("mesh PLY", _file("mesh.ply", TRIANGLE), _parts(load_mesh, "vertices", "triangles")),
]

RECORDINGS = [loader.name for loader in LOADERS if loader.read is _dataset]
