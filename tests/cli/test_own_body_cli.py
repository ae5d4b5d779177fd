"""A robot's arm hangs before its camera: with what is known of the arm, ``map`` has nothing of it, and all of
the room that was seen beside it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from armed_room import HALF_M, ArmedRoom, T_camera_bar, missed_m, record, to_bar_m, write_urdf
from console import FAST, as_process, assert_refused, taichi_mrf
from datasets_recordings import write_image
from scipy.spatial import cKDTree

import taichi_mrf as tm
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.system import runtime

VOXEL_M = 0.05
SETTINGS = (*FAST, "--voxel-size", str(VOXEL_M), "--noise", "given", "--force")


def mapped(out: Path, source: Path, *flags: str) -> tuple[np.ndarray, str]:
    """Centres (N, 3) of the occupied voxels in order, and what ``map`` printed."""
    done = as_process("map", source, "--out", out, *SETTINGS, *flags)
    assert done.returncode == 0, done.stderr
    return np.unique(tm.load_map(out / "map.npz").voxels()[0], axis=0), done.stdout


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> ArmedRoom:
    """The arm never moves."""
    runtime.init("cpu")
    return record(tmp_path_factory.mktemp("arm"), [-0.4] * 12)


@pytest.fixture(scope="module")
def bare(room: ArmedRoom, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """The map without an arm."""
    return mapped(tmp_path_factory.mktemp("bare"), room.plain)[0]


@pytest.fixture(scope="module")
def expected(room: ArmedRoom, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """The map without an arm, whose pixels there were not measured."""
    folder = tmp_path_factory.mktemp("holes")
    (folder / "camera.txt").write_bytes((room.plain / "camera.txt").read_bytes())
    for index in range(len(room.bare)):
        pose, name = f"frame-{index:06d}.pose.txt", f"frame-{index:06d}.depth.png"
        (folder / pose).write_bytes((room.plain / pose).read_bytes())
        image = cv2.imread(str(room.plain / name), cv2.IMREAD_UNCHANGED)
        write_image(folder / name, np.where(room.is_bar(index), 0, image).astype(np.uint16))
    return mapped(tmp_path_factory.mktemp("expected"), folder)[0]


def of_the_bar(centres: np.ndarray, room: ArmedRoom, bare: np.ndarray) -> int:
    """How many voxels lie where a frame had its bar, and not at a surface of the room."""
    alone = centres[cKDTree(bare).query(centres, p=np.inf)[0] > 1.5 * VOXEL_M]
    near = np.zeros(len(alone), bool)
    for frame, angle in zip(room.bare, room.angles, strict=True):
        T = inverse(frame.T_world_camera)
        near |= to_bar_m(alone @ T[:3, :3].T + T[:3, 3], angle) < VOXEL_M
    return int(near.sum())


def test_an_arm_is_smeared_over_the_map(room: ArmedRoom, bare: np.ndarray, tmp_path: Path) -> None:
    smeared, _ = mapped(tmp_path / "out", room.armed)
    assert of_the_bar(smeared, room, bare) > 40
    assert of_the_bar(bare, room, bare) == 0


def test_a_masked_arm_is_not_in_the_map(
    room: ArmedRoom, bare: np.ndarray, expected: np.ndarray, tmp_path: Path
) -> None:
    mask = write_image(tmp_path / "arm.png", np.where(room.is_bar(0), 0, 255).astype(np.uint8))
    found, said = mapped(tmp_path / "out", room.armed, "--mask", str(mask))
    assert of_the_bar(found, room, bare) == 0
    assert "arm.png covers " in said
    np.testing.assert_array_equal(found, expected)


def test_an_arm_in_a_box_is_not_in_the_map(room: ArmedRoom, expected: np.ndarray, tmp_path: Path) -> None:
    T, sides = T_camera_bar(-0.4), np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    corners = sides * HALF_M @ T[:3, :3].T + T[:3, 3]
    box = [f"{x:.3f}" for x in (*(corners.min(axis=0) - 0.01), *(corners.max(axis=0) + 0.01))]
    found, said = mapped(tmp_path / "out", room.armed, "--body-box", *box)
    assert "measurements are left out in 1 box" in said
    np.testing.assert_array_equal(found, expected)


def test_a_mask_that_does_not_fit_is_one_line(room: ArmedRoom, tmp_path: Path) -> None:
    mask = write_image(tmp_path / "arm.png", np.full((60, 80), 255, np.uint8))
    for command in (("map", "--out", str(tmp_path / "out")), ("info",), ("doctor",)):
        done = taichi_mrf(command[0], room.armed, *command[1:], "--mask", mask)
        assert_refused(done, "arm.png: the mask has 80 x 60 pixels", "armed 160 x 120", "as it is stored")


def test_an_arm_that_moves_is_not_in_the_map(bare: np.ndarray, tmp_path: Path) -> None:
    """By its URDF and a table of its joints; what is seen by it at more than 2 cm stays as it is."""
    pytest.importorskip("yourdfpy")
    runtime.init("cpu")
    room = record(tmp_path, [-0.6 + 0.05 * i for i in range(12)])
    stamps = tm.open_dataset(room.armed).stamps()
    rows = [f"{stamps[i]},{room.angles[i]}" for i in (0, 11)]
    joints = tmp_path / "joints.csv"
    joints.write_text("\n".join(["stamp,elbow", *rows]))
    urdf = str(write_urdf(tmp_path / "arm.urdf"))
    flags = ("--robot", urdf, "--camera-link", "optical", "--joints", str(joints))
    smeared, _ = mapped(tmp_path / "smeared", room.armed)
    found, said = mapped(tmp_path / "out", room.armed, *flags)
    assert "grown by 0.02 m" in said
    assert of_the_bar(smeared, room, bare) > 40
    assert of_the_bar(found, room, bare) == 0
    body = OwnBody(robot=urdf, camera_link="optical", joints=str(joints))
    seen = tm.open_dataset(room.armed, body=body)
    for index, plain in enumerate(tm.open_dataset(room.plain)):
        depth_m, missed = seen.read(index).depth_m, missed_m(plain.camera, room.angles[index])
        np.testing.assert_array_equal(depth_m[missed > 0.022], plain.depth_m[missed > 0.022])
        assert not depth_m[missed < 0.017].any()
