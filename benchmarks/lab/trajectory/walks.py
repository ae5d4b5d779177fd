"""The walks that cameras are tracked on: through the built-in scenes and the house, and the recorded kitchen.

Images are small, because tracking uses no more. Frames are held in memory, so that reading them counts for
nobody.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import open_dataset
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.synthetic.analytic_render import render
from taichi_mrf.datasets.synthetic.analytic_scene import Scene
from taichi_mrf.datasets.synthetic.corridor import (
    LAMP_OVER_EYE_M,
    SmoothPath,
    corridor_scene,
    pose_on_path,
    ring_path,
    ring_scene,
    waypoints,
)
from taichi_mrf.datasets.synthetic.mesh_scene import MeshScene, load_mesh
from taichi_mrf.datasets.synthetic.rendered_sequence import RenderOptions, mottled
from taichi_mrf.datasets.synthetic.room_furniture import camera_pose, room_scene
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.simulate import KINECT_1, Seed, simulate

WIDTH, HEIGHT = 160, 120
RATES = (30.0, 10.0, 5.0)
"""Images a second of the simulated walks."""

SPEED, OFFICE_SPEED = 0.8, 0.45
"""Metres a second through the corridor and the house, and of the handheld camera, which turns more often."""

HOLD_OUT = 10
"""One frame in so many is tracked but not mapped, and judges the map."""

ROOM, ROOM_COLOR = "room", "room in colour"
RING, RING_COLOR = "corridor", "corridor in colour"
BARE, BARE_COLOR = "bare corridor", "bare corridor in colour"
HOUSE, OFFICE, OFFICE_COLOR = "house", "handheld", "handheld in colour"
KITCHEN, KITCHEN_COLOR = "kitchen", "kitchen in colour"

ROOM_SECONDS = 10.0
"""Once around the room: 7.8 m and 450 degrees."""

RING_M = 60.0
OFFICE_ROOMS = 2

HOUSE_PATH = (
    (3.0, -3.8), (5.4, -3.0), (5.8, -1.2), (4.6, 0.8), (1.6, 1.9), (-1.0, 1.9), (-1.6, 0.0), (-3.0, -0.4),
    (-4.6, 0.3), (-7.6, 0.1), (-8.7, -1.6), (-7.4, -3.2), (-4.8, -3.3), (-3.2, -2.2), (-1.7, -2.2),
    (-1.6, -3.9), (0.5, -3.9), (3.0, -3.8), (4.5, -3.4),
)  # fmt: skip
"""Corners of a path through all rooms of the house, in metres; it ends a little beyond its beginning."""

SHAKE_M, SHAKE_RAD = 0.02, math.radians(1.5)
"""Amplitudes along and about each axis by which the hand that carries a camera shakes it, and at which
frequencies (Hz)."""
SHAKE_HZ = ((0.9, 1.7, 0.6), (1.3, 0.8, 1.1))


@dataclass
class Walk(Dataset):
    """Frames at their true, or recorded, poses, and the clean depth, (H, W) in metres, of those that judge
    the map, by index; in a recording what was measured."""

    frames: Sequence[Frame] = ()
    clean_m: dict[int, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def frame_names(self) -> Sequence[str]:
        """The frames' names in order."""
        return [frame.name for frame in self.frames]

    def read(self, index: int) -> Frame:
        """A frame."""
        return self.frames[index]

    @property
    def true_poses(self) -> dict[float, Pose]:
        """T_world_camera of all frames by index."""
        return {float(index): frame.T_world_camera for index, frame in enumerate(self.frames)}


@dataclass(frozen=True)
class CameraPath:
    """A path through a simulated scene: how a picture is taken there (axial depth, and RGB if asked for), and
    where the camera is after so many seconds."""

    picture: Callable[[Pose, bool], tuple[NDArray[np.float32], NDArray[np.uint8] | None]]
    pose_at: Callable[[float], Pose]
    seconds: float

    def frame(
        self, seconds: float, name: str, seed: Seed, color: bool = False
    ) -> tuple[Frame, NDArray[np.float32]]:
        """Depth that a Kinect 1 measures at that time, and the clean depth, (H, W) in metres."""
        T, camera = self.pose_at(seconds), small_camera()
        clean_m, rgb = self.picture(T, color)
        depth_m = simulate(clean_m, camera, KINECT_1, seed)
        return Frame(depth_m, T, camera, seconds, name, rgb), clean_m


@dataclass(frozen=True)
class Source:
    """A walk that can be taken: its name, the rates at which it is, and how it is taken."""

    name: str
    rates: Sequence[float]
    take: Callable[[Experiment, float], Walk]


def walk_name(source: Source, rate: float) -> str:
    """Name of a walk in tables and after ``--only``."""
    return f"{source.name}, {rate:g} Hz"


def sources() -> list[Source]:
    """All walks."""
    simulated = {
        ROOM: (room_walk, False),
        ROOM_COLOR: (room_walk, True),
        HOUSE: (_house, False),
        OFFICE: (_office, False),
        OFFICE_COLOR: (_office, True),
        RING: (partial(ring_walk, False), False),
        RING_COLOR: (partial(ring_walk, False), True),
        BARE: (partial(ring_walk, True), False),
        BARE_COLOR: (partial(ring_walk, True), True),
    }
    taken = [
        Source(name, RATES, lambda e, rate, n=name, w=path, c=color: simulated_walk(e, n, w(e.data), rate, c))  # type: ignore[misc]
        for name, (path, color) in simulated.items()
    ]
    recorded = [
        Source(name, (3.0,), lambda e, rate, c=color: kitchen_walk(e, rate, c))  # type: ignore[misc]
        for name, color in ((KITCHEN, False), (KITCHEN_COLOR, True))
    ]
    return [*recorded, *taken]


def simulated_walk(experiment: Experiment, name: str, path: CameraPath, rate: float, color: bool) -> Walk:
    """The frames of a path at ``rate`` images a second, with a Kinect 1's noise."""
    frames, clean = [], {}
    for index in range(round(path.seconds * rate))[: experiment.limit]:
        frame, true_m = path.frame(index / rate, f"{name}-{index:04d}", (experiment.seeds[0], index), color)
        frames.append(frame)
        if is_held_out(index + 1, HOLD_OUT):
            clean[index] = true_m
    return Walk(f"{name}, {rate:g} Hz", small_camera(), frames=frames, clean_m=clean)


def kitchen_walk(experiment: Experiment, rate: float, color: bool) -> Walk:
    """The recording, every tenth image at 30 a second, with the poses that it brings along."""
    folder = experiment.data / "seven_scenes_redkitchen"
    width = open_dataset(folder, color=False).camera.width
    dataset = open_dataset(folder, color=color, image_scale=min(1.0, WIDTH / width))
    frames = [replace(dataset.read(i), stamp=i / rate) for i in range(len(dataset))[: experiment.limit]]
    clean = {i: f.depth_m for i, f in enumerate(frames) if is_held_out(i + 1, HOLD_OUT)}
    return Walk(f"{KITCHEN}, {rate:g} Hz", dataset.camera, frames=frames, clean_m=clean)


def small_camera() -> PinholeCamera:
    """The camera of all simulated walks."""
    return RenderOptions(width=WIDTH, height=HEIGHT).camera()


def room_walk(data: Path) -> CameraPath:
    """Once around the built-in room."""
    return _rendered(
        room_scene(), lambda seconds: camera_pose(seconds / ROOM_SECONDS), ROOM_SECONDS, carried_lamp=False
    )


def ring_walk(bare: bool, data: Path) -> CameraPath:
    """Once around the ring corridor."""
    path = ring_path(RING_M)
    return _rendered(
        ring_scene(RING_M, bare), lambda seconds: path.pose_at(seconds * SPEED), path.length_m / SPEED
    )


def _office(data: Path) -> CameraPath:
    """Into two rooms off a corridor and out again, with the camera in a hand."""
    path = waypoints(OFFICE_ROOMS)
    seconds = float(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).sum()) / OFFICE_SPEED
    return _rendered(
        corridor_scene(OFFICE_ROOMS), lambda t: shaken(pose_on_path(path, t / seconds), t), seconds
    )


def _house(data: Path) -> CameraPath:
    scene = MeshScene(load_mesh(data / "meshes" / "house.ply"))
    path, camera = SmoothPath(HOUSE_PATH), small_camera()
    return CameraPath(
        lambda T, color: (scene.render_depth(camera, T), None),
        lambda seconds: path.pose_at(seconds * SPEED),
        path.length_m / SPEED,
    )


def shaken(T_world_camera: Pose, seconds: float) -> Pose:
    """A pose as a hand holds the camera there at that time."""
    phases = 2 * math.pi * np.multiply(SHAKE_HZ, seconds) + np.arange(6).reshape(2, 3)
    return moved(T_world_camera, (np.sin(phases) * [[SHAKE_M], [SHAKE_RAD]]).ravel())


def _rendered(
    scene: Scene, pose_at: Callable[[float], Pose], seconds: float, carried_lamp: bool = True
) -> CameraPath:
    """A path through an analytic scene. Its lamp, or one over the camera, lights the colour images, in which
    everything is mottled."""
    camera = small_camera()

    def picture(T: Pose, color: bool) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
        x, y, z = T[:3, 3].tolist()
        lit = replace(scene, light=(x, y, z + LAMP_OVER_EYE_M)) if carried_lamp else scene
        depth_m, rgb = render(lit, camera, T, color)
        return depth_m, None if rgb is None else mottled(rgb, depth_m, camera, T)

    return CameraPath(picture, pose_at, seconds)
