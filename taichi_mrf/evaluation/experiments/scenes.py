"""The scenes that maps are judged on: what a sensor measured, and what is known of the truth.

Where depth is clean it is what a perfect sensor would measure, and the noise is simulated here, so that
the truth stays known. data/README.md describes the layout of the folders.
"""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import PatchNoise, PinholeCamera, PolynomialNoise, TaichiMRFError, open_dataset
from taichi_mrf.config.schema import KeyframeConfig, VolumeConfig, load
from taichi_mrf.datasets.formats.numbered_depth import NAME as NUMBERED
from taichi_mrf.datasets.images import read_depth
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M
from taichi_mrf.datasets.recording import Recording
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, as_pose, look_at
from taichi_mrf.mapping.selection import KeyframeSelector
from taichi_mrf.sensor.camera import Camera, pinhole
from taichi_mrf.sensor.noise import NoiseModel, noise_from_config
from taichi_mrf.sensor.simulate import KINECT_1_LATERAL, simulate, simulate_model
from taichi_mrf.system.files import is_folder

HOUSE = "house_livingroom"
"""Folder of Table II's own scene."""

NOISY = "depth_noisy"
"""Folder of the simulated measurements beside Redwood's clean depth, as Open3D's downloads call it."""

MAPPED_BY = "realsense_d435"
"""Configuration of the sensor that maps where another one judges."""

MOST_HELD = 64
"""Views of a folder that are kept in memory; Redwood's rooms have thousands."""

COFFIN_VOLUME = ((-2.0, -2.0, 0.0), (2.0, 2.0, 3.0))
"""The walls, floor and boxes of MRFMap's Table I lie in this box; a view sees floor beyond it."""

COFFIN_MARGIN = 0.4
"""The map may reach this far out of the volume, so that noise in front of a wall and behind it is mapped."""

EDGE = 0.01
"""A surface counts as in the volume up to this far outside (metres): walls stand on its faces."""

OFF_THE_GRID_M = np.array([0.0137, 0.0221, 0.0183])
"""By this the coffin scene is moved where single voxels count: its walls stand in planes of the grid, where
rounding decides which voxel holds them."""

TURN = look_at(OFF_THE_GRID_M, OFF_THE_GRID_M + np.array([1.0, 0.4, -0.2]), (0.1, 0.0, 1.0))
"""Moves scenes so that surfaces cut voxels in all ways. Walls in planes of the grid, as those of the house,
are a voxel off as a whole or not at all, and shares of voxels mean little there."""

TURNED = ", turned"

LIDAR_RANGE_M = 60.0

_UNREADABLE = (OSError, ValueError, EOFError, zipfile.BadZipFile)
"""Errors that NumPy raises for a file that is missing or damaged."""

COFFIN_SEED = 100
"""View i of noise seed s is drawn with COFFIN_SEED + 1000 s + i."""


@dataclass(frozen=True)
class SceneView:
    """One view. ``measured_m`` and ``true_m`` are (H, W) depth in metres, 0 for none; in a recording what was
    measured is all that is known of the truth. ``judged`` (H, W): pixels that count. ``stamp_s`` is when it
    was taken, in seconds; None if nothing is known of that. ``sigma_m`` (H, W) is the standard deviation of
    each pixel's depth in metres; None if that of the sensor holds. ``camera`` and ``noise`` are None for the
    scene's."""

    name: str
    T_world_camera: Pose
    measured_m: NDArray[np.float32]
    true_m: NDArray[np.float32]
    judged: NDArray[np.bool_]
    stamp_s: float | None = None
    sigma_m: NDArray[np.float32] | None = None
    camera: Camera | None = None
    noise: NoiseModel | None = None


class ViewsOnDemand(Sequence[SceneView]):
    """Views that are read when they are asked for; the last MOST_HELD are kept. ``pose`` gives T_world_camera
    of one of them, (4, 4), and reads no image."""

    def __init__(self, indices: range, read: Callable[[int], SceneView], pose: Callable[[int], Pose]) -> None:
        """``read`` and ``pose`` are of the frame with an index."""
        self._indices, self._read = indices, lru_cache(MOST_HELD)(read)
        self.pose: Callable[[int], Pose] = lambda index: pose(indices[index])

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> SceneView: ...

    @overload
    def __getitem__(self, index: slice) -> list[SceneView]: ...

    def __getitem__(self, index: int | slice) -> SceneView | list[SceneView]:
        if isinstance(index, slice):
            return [self._read(i) for i in self._indices[index]]
        return self._read(self._indices[index])


@dataclass(frozen=True)
class Scene:
    """Views of one place by one sensor, its noise, and where the map may be. ``camera`` is that of all views
    that have none of their own."""

    name: str
    camera: Camera
    noise: NoiseModel
    volume: VolumeConfig
    max_depth: float
    views: Sequence[SceneView]

    @property
    def pinhole(self) -> PinholeCamera:
        """The camera, for what works with pinholes alone. Raises ConfigError for any other."""
        return pinhole(self.camera, self.name)

    def pose(self, index: int) -> Pose:
        """T_world_camera of a view, (4, 4)."""
        views = self.views
        return views.pose(index) if isinstance(views, ViewsOnDemand) else views[index].T_world_camera


def coffin_scene(data: Path, seed: int = 0) -> Scene:
    """MRFMap's Table I: 12 views of a room with a box, measured with the learnt noise of a RealSense D435.

    Raises DatasetError if a file of ``data``/coffin_world is missing or does not hold what it should.
    """
    folder = data / "coffin_world"
    camera, clean, poses = _clean_views(folder / "clean_depth.npz")
    noise = _learnt_noise(folder, camera)
    lower, upper = (np.asarray(corner) for corner in COFFIN_VOLUME)
    views = []
    for index, (depth, T_world_camera) in enumerate(zip(clean, poses, strict=True)):
        true = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        measured = simulate_model(true, camera, noise, seed=COFFIN_SEED + 1000 * seed + index)
        inside = _inside(true, camera, T_world_camera, lower - EDGE, upper + EDGE)
        views.append(SceneView(f"view {index:02d}", T_world_camera, measured, true, inside))
    box = (tuple((lower - COFFIN_MARGIN).tolist()), tuple((upper + COFFIN_MARGIN).tolist()))
    volume = VolumeConfig(lower=box[0], upper=box[1])
    return Scene("coffin_world", camera, noise, volume, 20.0, views)


def living_room_scene(data: Path, seed: int = 0, limit: int | None = None) -> Scene:
    """MRFMap's Table II: the house of ``data``, or ``data`` itself, as the paper's own room, if it is in the
    layout of ICL-NUIM or Redwood. Raises DatasetError if it is neither."""
    if is_folder(data / HOUSE):
        return house_scene(data, seed, limit)
    if (found := format_name(data)) == NUMBERED:
        return redwood_scene(data, seed, limit)
    what = "in no known layout" if found == "unknown" else f"in the layout of {found}"
    raise DatasetError(
        f"{data}: has no folder {HOUSE}/, and is {what}; --data must name the folder with the scenes, or a "
        f"recording in that of {NUMBERED}: clean depth in depth/NNNNN.png, a Kinect's in {NOISY}/ (simulated "
        "if it is missing), and the trajectory, as livingroom1-traj.txt"
    )


def house_scene(data: Path, seed: int = 0, limit: int | None = None) -> Scene:
    """In the manner of MRFMap's Table II: clean views of a living room, with the noise of a Kinect 1."""
    scene = redwood_scene(data / HOUSE, seed, limit)
    return replace(scene, views=list(scene.views))


def redwood_scene(folder: Path, seed: int = 0, limit: int | None = None) -> Scene:
    """A folder of clean numbered depth images, and a Kinect's of the same names in NOISY; without that folder
    its measurements are simulated. Views are read when they are asked for. Raises DatasetError."""
    dataset, noisy = open_dataset(folder, color=False), folder / NOISY
    camera, has_noisy = pinhole(dataset.camera, folder.name), is_folder(noisy)

    def read(index: int) -> SceneView:
        frame = dataset.read(index)
        depth = frame.depth_m
        if has_noisy and isinstance(dataset, Recording):
            measured = read_depth(noisy / f"{frame.name}.png", dataset.steps_per_metre, camera)
        else:
            measured = simulate(depth, camera, KINECT_1_LATERAL, seed=(seed, index))
        return SceneView(frame.name, frame.T_world_camera, measured, depth, depth > 0)

    views = ViewsOnDemand(range(len(dataset))[:limit], read, dataset.pose)
    noise = PolynomialNoise(KINECT_1_LATERAL.sigma, KINECT_1_LATERAL.bias)
    return Scene(folder.resolve().name, camera, noise, VolumeConfig(), 10.0, views)


def kitchen_scene(data: Path, limit: int | None = None) -> Scene:
    """In the manner of MRFMap's Table III: a real recording, for which the measured depth must do."""
    dataset = open_dataset(data / "seven_scenes_redkitchen", color=False)
    views = []
    for index in range(len(dataset))[:limit]:
        frame = dataset.read(index)
        depth = frame.depth_m
        views.append(SceneView(frame.name, frame.T_world_camera, depth, depth, depth > 0, frame.stamp))
    noise = PolynomialNoise(KINECT_1_LATERAL.sigma, KINECT_1_LATERAL.bias)
    return Scene(
        "seven_scenes_redkitchen", pinhole(dataset.camera, "the kitchen"), noise, VolumeConfig(), 10.0, views
    )


def judged_scene(data: Path, judge: str, seed: int = 0, limit: int | None = None) -> Scene:
    """As MRFMap's Table III was judged: a RealSense D435 measures every second view of the house for the map,
    and the sensor of a parameter file or of a shipped configuration the others, which judge.

    What a view's sensor measures takes the place of the truth. Raises ConfigError for an unknown ``judge``.
    """
    sensors = [load(each).sensor for each in (MAPPED_BY, judge)]
    clean = house_scene(data, seed, limit)
    noises = [noise_from_config(sensor, clean.camera) for sensor in sensors]
    views = []
    for index, view in enumerate(clean.views):
        sensor, noise = sensors[index % 2], noises[index % 2]
        in_range = (view.true_m >= sensor.min_depth) & (view.true_m <= sensor.max_depth)
        true = np.where(in_range, view.true_m, np.float32(0))
        measured = simulate_model(true, clean.camera, noise, seed=(seed, index))
        views.append(replace(view, measured_m=measured, true_m=measured, judged=measured > 0, noise=noise))
    name = f"{clean.name} by {MAPPED_BY}, judged by {Path(judge).stem}"
    return replace(clean, name=name, noise=noises[0], views=views)


def lidar_scene(data: Path, limit: int | None = None) -> Scene:
    """The building; its noise is the data sheet's. Raises DatasetError."""
    dataset = open_dataset(data / "lidar_building")
    views = []
    for index in range(len(dataset))[:limit]:
        frame = dataset.read(index)
        depth, seen = frame.depth_m, (frame.depth_m > 0) & (frame.depth_m <= LIDAR_RANGE_M)
        views.append(
            SceneView(frame.name, frame.T_world_camera, depth, depth, seen, frame.stamp, camera=frame.camera)
        )
    noise = PolynomialNoise((LIDAR_SIGMA_M,))
    return Scene("lidar_building", dataset.camera, noise, VolumeConfig(), LIDAR_RANGE_M, views)


def turned(scene: Scene, mesh: TriangleMesh) -> tuple[Scene, TriangleMesh]:
    """A scene and its mesh moved by TURN; its volume is the box around the moved one."""
    views = [replace(view, T_world_camera=TURN @ view.T_world_camera) for view in scene.views]
    volume = scene.volume
    if volume.lower is not None and volume.upper is not None:
        corners = np.array(list(product(*zip(volume.lower, volume.upper, strict=True))))
        moved = corners @ TURN[:3, :3].T + TURN[:3, 3]
        x, y, z = moved.min(axis=0).tolist()
        volume = replace(volume, lower=(x, y, z))
        x, y, z = moved.max(axis=0).tolist()
        volume = replace(volume, upper=(x, y, z))
    vertices = mesh.vertices @ TURN[:3, :3].T + TURN[:3, 3]
    there = replace(scene, name=scene.name + TURNED, views=views, volume=volume)
    return there, TriangleMesh(vertices, mesh.triangles)


def off_the_grid(scene: Scene) -> Scene:
    """A scene that fills its volume, moved by OFF_THE_GRID_M."""
    there = np.eye(4)
    there[:3, 3] = OFF_THE_GRID_M
    views = [replace(view, T_world_camera=there @ view.T_world_camera) for view in scene.views]
    lower, upper = (
        tuple((np.asarray(corner) + OFF_THE_GRID_M).tolist())
        for corner in (scene.volume.lower, scene.volume.upper)
    )
    return replace(scene, views=views, volume=VolumeConfig(lower=lower, upper=upper))


def keyframes_of(scene: Scene, rotation: float, translation: float) -> list[int]:
    """Indices of the views that the geometric heuristic of section V makes keyframes."""
    selector = KeyframeSelector(KeyframeConfig(rotation=rotation, translation=translation))
    chosen = []
    for index in range(len(scene.views)):
        pose = scene.pose(index)
        if selector.wants(pose):
            selector.accept(pose)
            chosen.append(index)
    return chosen


def _clean_views(path: Path) -> tuple[PinholeCamera, NDArray[np.floating], list[Pose]]:
    """Camera, axial depth (n, H, W) in metres and T_world_camera of Table I's views."""
    try:
        with np.load(path) as file:
            clean, matrices, K = file["depth_m"], file["T_world_camera"], file["K"]
    except KeyError as error:
        raise DatasetError(f"{path}: {error.args[0]}") from error
    except _UNREADABLE as error:
        raise DatasetError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if clean.ndim != 3 or matrices.shape != (len(clean), 4, 4) or K.shape != (3, 3):
        raise DatasetError(
            f"{path}: depth_m {clean.shape}, T_world_camera {matrices.shape} and K {K.shape} do not go "
            "together: (n, H, W), (n, 4, 4) and (3, 3) are expected"
        )
    height, width = clean.shape[1:]
    try:
        camera = PinholeCamera(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return camera, clean, [as_pose(matrix) for matrix in matrices]
    except TaichiMRFError as error:
        raise DatasetError(f"{path}: {error}") from error


def _learnt_noise(folder: Path, camera: PinholeCamera) -> PatchNoise:
    """The noise of Table I's sensor, in whatever square patches its tables divide the image."""
    tables = []
    for name in ("stddev", "bias"):
        path = folder / f"realsense_{name}_poly5x.npy"
        try:
            tables.append(np.load(path))
        except _UNREADABLE as error:
            raise DatasetError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    sigma, bias = tables
    rows = sigma.shape[0] if sigma.ndim else 0
    for patch in range(1, max(camera.width, camera.height) + 1):
        if -(-camera.width // patch) * -(-camera.height // patch) == rows:
            break
    else:
        raise DatasetError(
            f"{folder / 'realsense_stddev_poly5x.npy'}: no square patch divides {camera.width} x "
            f"{camera.height} pixels into {rows}"
        )
    try:
        return PatchNoise(sigma, bias, patch, camera)
    except TaichiMRFError as error:
        raise DatasetError(f"{folder}/realsense_*_poly5x.npy: {error}") from error


def _inside(
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    T_world_camera: Pose,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Pixels with a depth whose surface lies in a box, (H, W)."""
    points = camera.rays() * depth_m[..., None].astype(np.float64)
    points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    return (depth_m > 0) & ((points >= lower) & (points <= upper)).all(axis=-1)
