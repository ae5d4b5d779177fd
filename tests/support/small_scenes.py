"""A data folder as ``taichi-mrf eval`` reads it, of one small room: seconds instead of hours.

The room reaches so far along -x that one wall lies outside the volume of Table I, as some of
the floor does in the real ``coffin_world``. A box stands in the middle; the cameras go round it.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from taichi_mrf.datasets.synthetic.analytic_render import render
from taichi_mrf.datasets.synthetic.analytic_scene import Point, Scene, Solid
from taichi_mrf.datasets.synthetic.mesh_scene import scene_mesh
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Ledger
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.simulate import KINECT_1, simulate

CAMERA = PinholeCamera(width=80, height=60, fx=65.6, fy=65.6, cx=39.5, cy=29.5)
PATCH = 20
"""Side in pixels of the patches of the noise tables: 3 rows of 4."""

COFFIN_VIEWS, HOUSE_VIEWS, KITCHEN_VIEWS = 4, 5, 4
FLOOR, FAR_WALL = 0.03, -2.57
"""z of the floor, and x of the wall outside the volume of Table I. No surface of the room lies in a plane
between voxels of a round size, where rounding would decide which of two it is in."""

TOO_FAR = 0.5
"""Metres by which the measurements of Redwood's layout are off: they cannot be taken for clean depth."""

EMPTY = 3
"""Row of the clean coffin depth that holds NaN, as the sky does in the real one."""


def room() -> Scene:
    """Floor, walls and a ceiling, and a box in the middle."""

    def slab(lower: Point, upper: Point) -> Solid:
        x, y, z = (0.5 * (a + b) for a, b in zip(lower, upper, strict=True))
        half_x, half_y, half_z = (0.5 * (b - a) for a, b in zip(lower, upper, strict=True))
        return Solid("box", (x, y, z), (half_x, half_y, half_z))

    return Scene(
        (
            slab((-2.8, -2.1, -0.2), (2.1, 2.1, FLOOR)),
            slab((-2.8, -2.1, 2.53), (2.1, 2.1, 2.7)),
            slab((-2.8, -2.1, FLOOR), (FAR_WALL, 2.1, 2.53)),
            slab((1.87, -2.1, FLOOR), (2.1, 2.1, 2.53)),
            slab((-2.8, -2.1, FLOOR), (2.1, -1.92, 2.53)),
            slab((-2.8, 1.88, FLOOR), (2.1, 2.1, 2.53)),
            slab((-0.33, -0.28, FLOOR), (0.29, 0.24, 0.93)),
        ),
        light=(0.0, 0.0, 2.4),
    )


def poses(count: int, step: float) -> list[Pose]:
    """T_world_camera on a circle around the box, ``step`` radians apart, looking at it."""
    angles = [index * step for index in range(count)]
    return [
        look_at(np.array([1.5 * math.cos(a), 1.5 * math.sin(a), 1.4]), np.array([0.0, 0.0, 0.7]))
        for a in angles
    ]


def clean_depth(T_world_camera: Sequence[Pose]) -> list[np.ndarray]:
    """True axial depth, (60, 80) float32 in metres. Taichi has to run."""
    return [render(room(), CAMERA, pose, color=False)[0] for pose in T_world_camera]


def make_data(folder: Path) -> Path:
    """Write the scenes of all experiments but ``stereo``; returns the folder. Taichi has to run."""
    _coffin(folder / "coffin_world")
    _house(folder / "house_livingroom")
    _kitchen(folder / "seven_scenes_redkitchen")
    (folder / "meshes").mkdir()
    mesh = scene_mesh(room())
    trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).export(folder / "meshes" / "house.ply")
    return folder


def experiment(data: Path, out: Path, **options: Any) -> Experiment:
    """An experiment that writes to ``out``, which is made if need be, and goes on with what is there."""
    out.mkdir(exist_ok=True)
    return Experiment(data, out, Ledger(out / "ledger.jsonl", {}), **options)


def noise_tables() -> tuple[np.ndarray, np.ndarray]:
    """(sigma, bias), (12, 3) float32 each: a depth camera with a bias of some centimetres."""
    random = np.random.default_rng(5)
    patches = (CAMERA.height // PATCH) * (CAMERA.width // PATCH)
    sigma = np.array([0.004, 0.0, 0.004]) * random.uniform(0.7, 1.3, (patches, 3))
    bias = np.array([0.005, 0.01, 0.002]) * random.uniform(0.5, 1.5, (patches, 3))
    return sigma.astype(np.float32), bias.astype(np.float32)


def _coffin(folder: Path) -> None:
    folder.mkdir()
    T_world_camera = poses(COFFIN_VIEWS, 2 * math.pi / COFFIN_VIEWS)
    depth = np.stack(clean_depth(T_world_camera))
    depth[:, EMPTY] = np.nan
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    np.savez(folder / "clean_depth.npz", depth_m=depth, T_world_camera=np.stack(T_world_camera), K=K)
    sigma, bias = noise_tables()
    np.save(folder / "realsense_stddev_poly5x.npy", sigma)
    np.save(folder / "realsense_bias_poly5x.npy", bias)


def _house(folder: Path) -> None:
    folder.mkdir()
    T_world_camera = poses(HOUSE_VIEWS, 0.3)
    for index, depth in enumerate(clean_depth(T_world_camera)):
        _write_depth(folder / f"{index:04d}.png", depth, 5000)
    np.savetxt(folder / "T_world_camera.txt", [pose[:3].ravel() for pose in T_world_camera])
    _write_camera(folder)


def _kitchen(folder: Path) -> None:
    folder.mkdir()
    T_world_camera = poses(KITCHEN_VIEWS, 0.4)
    for index, (pose, depth) in enumerate(zip(T_world_camera, clean_depth(T_world_camera), strict=True)):
        stem = folder / f"frame-{index:06d}"
        _write_depth(Path(f"{stem}.depth.png"), simulate(depth, CAMERA, KINECT_1, seed=index), 1000)
        np.savetxt(f"{stem}.pose.txt", pose)
    _write_camera(folder)


def make_redwood(folder: Path) -> Path:
    """The house in the layout of Redwood's livingroom1, in millimetres, with measurements that are TOO_FAR;
    returns the folder. Taichi has to run."""
    T_world_camera = poses(HOUSE_VIEWS, 0.3)
    for name in ("depth", "depth_noisy"):
        (folder / name).mkdir(parents=True)
    log = []
    for index, (pose, depth) in enumerate(zip(T_world_camera, clean_depth(T_world_camera), strict=True)):
        _write_depth(folder / "depth" / f"{index:05d}.png", depth, 1000)
        _write_depth(folder / "depth_noisy" / f"{index:05d}.png", depth + TOO_FAR, 1000)
        log += [f"{index} {index} {index + 1}", *(" ".join(f"{x:.8f}" for x in row) for row in pose)]
    (folder / "livingroom1-traj.txt").write_text("\n".join(log) + "\n")
    (folder / "dist-model.txt").write_text("% a model of the noise\n" + "1.5\n" * 40)
    _write_camera(folder)
    return folder


def _write_depth(path: Path, depth_m: np.ndarray, steps_per_metre: float) -> None:
    cv2.imwrite(str(path), np.rint(depth_m * steps_per_metre).astype(np.uint16))


def _write_camera(folder: Path) -> None:
    k = CAMERA
    (folder / "camera.txt").write_text(f"{k.width} {k.height} {k.fx} {k.fy} {k.cx} {k.cy}\n")
