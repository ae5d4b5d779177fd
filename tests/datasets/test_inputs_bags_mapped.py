"""A bag of each kind with poses of each kind, mapped by the program: the same map as of the frames
themselves."""

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from console import taichi_mrf
from inputs_bags import Bag, Kind, writing
from inputs_frames import Frames, moved, room

from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.geometry.poses import inverse, look_at
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map

VOXEL_SIZE = 0.1
OPTICAL, LINK, BODY, ODOM, WORLD = "camera_optical", "camera_link", "base_link", "odom", "map"
T_body_link = look_at([0.2, -0.1, 0.3], [1.0, 0.2, 0.1])
T_link_optical = look_at([0.0, 0.02, 0.0], [0.1, 1.0, 0.3])
T_body_optical = T_body_link @ T_link_optical
DISPLACEMENT, TURN = (0.03, 0.02, -0.01), (0.01, -0.02, 0.05)
"""How far the body moves, in metres, and turns, in radians, in the 20 ms to either side of an image."""


@pytest.fixture(scope="module")
def frames(one_backend: str) -> Frames:
    return room()


@pytest.fixture(scope="module")
def direct(frames: Frames) -> OccupancyMap:
    """The map of the very frames that the bags are written from."""
    return mapped(frames)


@pytest.fixture(scope="module")
def rounding(frames: Frames, direct: OccupancyMap) -> float:
    """Mean difference in probability that the last bits of the poses make, the largest of a few: a map is
    inferred in an order that follows from a hash of what its keyframes hold."""
    differences = []
    for k in range(1, 5):
        nudge = np.zeros((4, 4))
        nudge[:3, 3] = k * 1e-12
        nudged = [replace(frame, T_world_camera=frame.T_world_camera + nudge) for frame in frames]
        differences.append(difference(mapped(Frames("nudged", frames.camera, frames=nudged)), direct))
    return max(differences)


def mapped(frames: Frames) -> OccupancyMap:
    return map_sequence(frames, Config(voxel_size=VOXEL_SIZE, evaluation=EvaluationConfig(hold_out=0))).map


def difference(a: OccupancyMap, b: OccupancyMap) -> float:
    """Mean difference in probability over the voxels of b, which must be as many as those of a."""
    assert a.statistics().voxels == b.statistics().voxels
    centres, probability = b.voxels(min_probability=0.0)
    return float(np.abs(a.occupancy(centres) - probability).mean())


def mounting(bag: Bag) -> None:
    bag.tf("/tf_static", 0.0, BODY, LINK, T_body_link)
    bag.tf("/tf_static", 0.0, LINK, OPTICAL, T_link_optical)


def as_odometry(bag: Bag, frames: Frames) -> None:
    """16UC1 images, and Odometry 20 ms before and after each, which the body passes on a straight line."""
    mounting(bag)
    bag.camera_info("/camera/depth/camera_info", OPTICAL, frames.camera)
    for frame in frames:
        bag.image("/camera/depth/image_raw", frame.stamp, OPTICAL, frames.millimetres(frame), "16UC1")
        T_world_body = frame.T_world_camera @ inverse(T_body_optical)
        for sign in (-1, 1):
            T = moved(T_world_body, DISPLACEMENT, TURN, sign)
            bag.odometry("/odom", frame.stamp + 0.02 * sign, WORLD, BODY, T)


def as_poses(bag: Bag, frames: Frames) -> None:
    """32FC1 images, and PoseStamped of a body that is not named."""
    mounting(bag)
    bag.camera_info("/depth/camera_info", OPTICAL, frames.camera)
    for frame in frames:
        bag.image(
            "/depth/image", frame.stamp, OPTICAL, np.where(frame.depth_m > 0, frame.depth_m, np.nan), "32FC1"
        )
        bag.pose_stamped("/tracker/pose", frame.stamp, WORLD, frame.T_world_camera @ inverse(T_body_optical))


def as_tf(bag: Bag, frames: Frames) -> None:
    """compressedDepth images, and a chain of two moving and two fixed transforms; colour and infrared
    beside."""
    mounting(bag)
    bag.camera_info("/cam/depth/camera_info", OPTICAL, frames.camera)
    bag.camera_info("/cam/color/camera_info", "color_optical", frames.camera)
    for i, frame in enumerate(frames):
        T_map_odom = look_at([0.1 * i, 0.0, 0.0], [1.0, 0.1 * i, 0.0])
        T_odom_body = inverse(T_map_odom) @ frame.T_world_camera @ inverse(T_body_optical)
        bag.tf("/tf", frame.stamp, WORLD, ODOM, T_map_odom)
        bag.tf("/tf", frame.stamp, ODOM, BODY, T_odom_body)
        bag.image(
            "/cam/color/image_raw", frame.stamp, "color_optical", np.zeros((60, 80, 3), np.uint8), "rgb8"
        )
        bag.image("/cam/infra1/image_rect_raw", frame.stamp, OPTICAL, np.ones((60, 80), np.uint16), "mono16")
        steps = frames.millimetres(frame)
        bag.compressed_depth("/cam/depth/image_raw/compressedDepth", frame.stamp, OPTICAL, steps)


BAGS: dict[str, tuple[Kind, Callable[[Bag, Frames], None], str]] = {
    "walk.bag": ("ros1", as_odometry, ""),
    "walk_sqlite": ("sqlite", as_poses, "/walk_sqlite.db3"),
    "walk_mcap": ("mcap", as_tf, "?frame=map"),
}
"""Name -> how it is written, and what follows the name of what is mapped."""


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_becomes_the_map_of_its_frames(
    name: str, frames: Frames, direct: OccupancyMap, rounding: float, tmp_path: Path
) -> None:
    kind, write, rest = BAGS[name]
    with writing(tmp_path / name, kind) as bag:
        write(bag, frames)
    settings = f"--voxel-size {VOXEL_SIZE} --evaluation.hold-out 0 --runtime.arch cpu --no-pictures"
    settings += " --inference.outlier-floor 1e-6"  # as the frames are mapped
    done = taichi_mrf("map", f"{tmp_path / name}{rest}", *shlex.split(settings), "--out", tmp_path / "out")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["keyframes"] == len(frames)
    assert report["dropped_frames"] == 0
    found = difference(load_map(tmp_path / "out" / "map.npz"), direct)
    assert found < 2 * rounding
