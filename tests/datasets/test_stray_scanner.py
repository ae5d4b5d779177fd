"""Stray Scanner's recordings: depth, poses, and confidence as a sigma for each pixel."""

from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import Content, write_image, write_stray
from refusals import bad_frame, refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise

CONTENT = Content(3)
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_stray(tmp_path / "walk", CONTENT)


def test_depth_poses_and_camera(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert (len(dataset), dataset.dropped) == (3, 0)
    camera = dataset.camera
    assert camera.shape == (192, 256)
    # A pixel of depth is a square of 7.5 pixels of colour: their middles and the rays to the corners agree.
    np.testing.assert_allclose(camera.directions(127.5, 95.5), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(camera.directions(255.5, 191.5), [960 / 1500, 720 / 1500, 1.0])
    for i, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.depth_m, np.resize(CONTENT.depth[i], (192, 256)) / 1000, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, CONTENT.poses[i], atol=1e-9)
        assert frame.stamp == pytest.approx(100 + 0.1 * i)
        assert frame.color is None


def test_confidence_is_a_sigma(folder: Path) -> None:
    dataset = open_dataset(folder)
    sigma_m = dataset.read(0).sigma_m
    np.testing.assert_allclose(sigma_m[:, :3], np.tile([np.inf, 0.02, 0.01], (192, 1)), rtol=1e-6)
    applied = with_recorded_noise(Config(), dataset)
    assert applied.sensor == SensorConfig(sigma=(0.01,))
    assert any("assumed for a phone's lidar" in note for note in dataset.notes)


def test_without_confidence_the_sigma_is_that_of_the_format(folder: Path) -> None:
    (folder / "confidence" / "000001.png").unlink()
    dataset = open_dataset(folder)
    assert dataset.stated.pixel_sigma
    assert dataset.read(1).sigma_m is None
    assert dataset.read(2).sigma_m is not None


def test_images_without_a_pose_are_dropped(folder: Path) -> None:
    lines = (folder / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join([*lines[:2], "", lines[3]]))
    dataset = open_dataset(folder)
    assert (dataset.frame_names, dataset.dropped) == (["000000", "000002"], 1)


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("odometry.csv", "", "names no column timestamp"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz\n", "names no column qw"),
        ("odometry.csv", HEADER + "1, 0, 0, 0\n", "line 2: expected 9 numbers"),
        ("odometry.csv", HEADER + "1,99,0,0,0,0,0,0,1\n", "a pose for none"),
        ("camera_matrix.csv", "1, 2, 3\n4, 5\n", "expected a 3 x 3 matrix"),
        ("camera_matrix.csv", "-9, 0, 3\n0, -9, 3\n0, 0, 1\n", "must be positive"),
    ],
)
def test_damaged_files_are_named(folder: Path, file: str, text: str, problem: str) -> None:
    (folder / file).write_text(text)
    refused(folder, str(folder / file), problem)


@pytest.mark.parametrize("levels", [np.full((192, 256), 3, np.uint8), np.ones((96, 128), np.uint8)])
def test_confidence_that_does_not_fit_is_named(folder: Path, levels: np.ndarray) -> None:
    path = write_image(folder / "confidence" / "000000.png", levels)
    bad_frame(open_dataset(folder), 0, f"{path}: has ", " levels up to")
    open_dataset(folder).read(1)
