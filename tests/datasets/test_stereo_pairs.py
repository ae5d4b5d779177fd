"""Stereo recordings in KITTI's layout and as a YAML file describes them: written here, read back as depth
frames, and broken in every way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    Content,
    row_of,
    write_image,
    write_log,
    write_rows,
    write_seven_scenes,
    write_stamped,
)
from numpy.typing import NDArray
from refusals import bad_frame, refused
from stereo_rig import BASELINE, CAMERA, COUNT, P0, P1, pairs, pose, poses, write, write_kitti

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise, with_tuned_noise
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, StereoPairs, stereo_depth
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera

NAMES = ["a", "b", "c"]
"""Of the images of a rig that a YAML file describes."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good recording of three pairs."""
    return write_kitti(tmp_path / "street")


def check_pairs(dataset: Dataset, poses: list[Pose]) -> None:
    """Its frames are those of the rendered pairs, at these poses."""
    assert isinstance(dataset, StereoPairs)
    assert dataset.camera == CAMERA
    assert dataset.rig.baseline_m == pytest.approx(BASELINE)
    for frame, pair, T_world_camera in zip(dataset, pairs(), poses, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, T_world_camera, atol=1e-9)
        np.testing.assert_array_equal(frame.color, np.repeat(pair.left[..., None], 3, axis=2))
        np.testing.assert_array_equal(frame.depth_m, stereo_depth(pair.left, pair.right, dataset.rig))
        found = frame.depth_m > 0
        assert found[pair.visible].mean() > 0.9
        disparity = BASELINE * CAMERA.fx / frame.depth_m[found]
        assert np.median(np.abs(disparity - pair.disparity[found])) < SIGMA_D_PX


def test_a_recording_comes_back_as_depth_frames(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert dataset.name == "street"
    check_pairs(dataset, poses())
    for i, frame in enumerate(dataset):
        assert (frame.name, frame.camera) == (f"{i:06d}", CAMERA)
        assert frame.stamp == pytest.approx(0.1 * i)


def test_the_notes_say_that_depth_is_stereo_and_how_good(folder: Path) -> None:
    stereo, stamps = open_dataset(folder).notes
    assert "stereo" in stereo
    assert "image_l and image_r" in stereo
    assert "0.2500 m" in stereo
    assert f"sigma_d = {SIGMA_D_PX}" in stereo
    assert f"{SIGMA_D_PX / (BASELINE * 100):.3e}" in stereo
    assert "times.txt" in stamps


def test_the_noise_of_the_rig_takes_the_place_of_the_default(folder: Path) -> None:
    dataset = open_dataset(folder, image_scale=0.5)
    own = (0.0, 0.0, SIGMA_D_PX / (BASELINE * 100))
    applied = with_recorded_noise(Config(), dataset)
    assert applied.sensor.sigma == pytest.approx(own)
    assert applied.sensor == replace(SensorConfig(), sigma=applied.sensor.sigma)
    assert dataset.notes[-1].startswith("sensor.sigma is [0, 0, ")
    assert with_recorded_noise(applied, dataset) is applied
    chosen = replace(Config(), sensor=SensorConfig(sigma=(0.05,)))
    for_all_pixels = with_recorded_noise(chosen, dataset)
    assert for_all_pixels.sensor == replace(chosen.sensor, pixel_sigma=False)
    assert "is not used" in dataset.notes[-2]
    assert "pixel_sigma is false" in dataset.notes[-1]
    assert with_recorded_noise(for_all_pixels, dataset) is for_all_pixels
    assert not with_tuned_noise(Config(), dataset).sensor.pixel_sigma


def test_a_recording_without_noise_of_its_own_keeps_the_default(tmp_path: Path) -> None:
    dataset = open_dataset(write_seven_scenes(tmp_path / "office", Content(1)))
    assert with_recorded_noise(Config(), dataset) == Config()
    assert dataset.notes == []


def test_kittis_own_names_labels_and_times(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "04", "image_0", "image_1")
    extra = f"P2: {row_of(P0)}\nP3: {row_of(P0)}\nTr: {row_of(np.eye(4)[:3])}"
    (folder / "calib.txt").write_text(f"P0: {row_of(P0)}\nP1: {row_of(P1)}\n{extra}\n")
    (folder / "times.txt").write_text("0.0\n1.036e-01\n0.25\n\n")
    dataset = open_dataset(folder)
    assert len(dataset.notes) == 1
    assert [frame.stamp for frame in dataset] == [0.0, 0.1036, 0.25]
    assert dataset.camera == CAMERA
    assert (dataset.read(0).depth_m > 0).mean() > 0.8


def test_the_callers_word_wins(folder: Path) -> None:
    camera = PinholeCamera(160, 60, 50.0, 50.0, 80.0, 30.0)
    plain, other = open_dataset(folder), open_dataset(folder, camera=camera, color=False)
    assert other.camera == camera
    frame = other.read(1)
    assert frame.color is None
    np.testing.assert_allclose(frame.depth_m, plain.read(1).depth_m / 2, rtol=1e-6)
    refused(folder, "depth_scale", depth_scale=1000.0)


@pytest.mark.parametrize("side", ["image_l", "image_r"])
def test_a_missing_image_is_named_and_the_others_are_read(folder: Path, side: str) -> None:
    (folder / side / "000001.png").unlink()
    dataset = open_dataset(folder)
    assert len(dataset) == COUNT
    bad_frame(dataset, 1, f"{folder / side / '000001.png'}: the image is missing")
    assert (dataset.read(2).depth_m > 0).any()


def test_a_pose_that_is_none_and_an_image_of_another_size_are_named(folder: Path) -> None:
    write_image(folder / "image_r/000002.png", np.zeros((60, 150), np.uint8))
    bad_frame(open_dataset(folder), 2, "image_r", " 150 x 60 pixels, the camera 160 x 60")
    write_rows(folder / "poses.txt", [np.eye(4), 2 * np.eye(4), np.eye(4)])
    bad_frame(open_dataset(folder), 1, "poses.txt line 2")


@pytest.mark.parametrize("change", [-1, 1])
def test_a_wrong_number_of_poses_or_stamps_is_refused(folder: Path, change: int) -> None:
    (folder / "times.txt").write_text("\n".join(str(i) for i in range(COUNT + change)))
    refused(folder, f"times.txt: contains {COUNT + change} stamps for 3 stereo pairs")
    write_rows(folder / "poses.txt", [np.eye(4)[:3]] * (COUNT + change))
    refused(folder, f"poses.txt: contains {COUNT + change} poses for 3 stereo pairs")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "P0 is missing"),
        (row_of(P0), "P1 is missing"),
        (f"P0: {row_of(P0)}\nP2: {row_of(P1)}", "P1 is missing"),
        (f"{row_of(P0)}\n{row_of(P1)} 1", "P1 must be 12 finite numbers .* has 13"),
        (f"{row_of(P0)}\n{row_of(P1).replace('80.5', 'nan')}", "P1 must be 12 finite numbers"),
        (f"{row_of(P0)}\n{row_of(P1).replace('80.5', 'wide')}", "P1 contains something that is not a number"),
        (f"{row_of(P0)}\n{row_of(P1 + np.eye(3, 4))}", "principal point: not rectified"),
        (f"{row_of(P0)}\n{row_of(P0)}", "baseline_m must be a positive"),
        (f"{row_of(P1)}\n{row_of(P0)}", "P0 must be at the origin"),
        (f"{row_of(P0)}\n{row_of(P1 + np.eye(3, 4, 2))}", "principal point: not rectified"),
        (f"{row_of(-P0)}\n{row_of(P1)}", "P0 is not the matrix of a pinhole camera"),
        (f"{row_of(P0 + np.eye(3, 4, 1))}\n{row_of(P1)}", "P0 is not the matrix of a pinhole camera"),
    ],
)
def test_a_bad_calibration_is_refused(folder: Path, text: str, said: str) -> None:
    (folder / "calib.txt").write_text(text)
    refused(folder, "calib.txt: ", *said.split(" .* "))


def test_other_broken_files_are_named(folder: Path) -> None:
    for text, said in (("0\n0.1\nsoon", ""), ("0\n0.1\ninf", ": the stamp is not finite")):
        (folder / "times.txt").write_text(text)
        refused(folder, f"times.txt line 3{said}")
    (folder / "times.txt").unlink()
    (folder / "poses.txt").write_text("\n".join(["0 0 0 0 0 0 0 1"] * COUNT))
    refused(folder, "poses.txt: expected a 3 x 4 matrix")
    images = [path for side in ("image_l", "image_r") for path in (folder / side).iterdir()]
    for path in images:
        path.write_bytes(b"")
    refused(folder, "image_l: none of its images can be read")
    for path in images:
        path.unlink()
    refused(folder, "no numbered images in image_l or image_r")


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    refused(folder, f"{name}: is missing")


@pytest.fixture(scope="module")
def kitti(shared_data: Path) -> StereoPairs:
    dataset = open_dataset(shared_data / "stereo_kitti" / "KITTI_sequence_1")
    assert isinstance(dataset, StereoPairs)
    return dataset


@pytest.mark.shared_data
def test_the_real_recording_opens(kitti: StereoPairs) -> None:
    assert len(kitti) == 51
    assert kitti.camera == PinholeCamera(1226, 370, 707.0912, 707.0912, 601.8873, 183.1104)
    assert kitti.baseline_m == pytest.approx(0.53715, abs=1e-5)
    frame = kitti.read(0)
    assert 0.6 < (frame.depth_m > 0).mean() < 0.9  # the sky and pale walls have none
    assert frame.depth_m.max() <= kitti.baseline_m * kitti.camera.fx / kitti.matching.least_disparity
    road = np.s_[250:, 560:690]
    depth_m = frame.depth_m[road]
    points = (kitti.camera.rays()[road] * depth_m[..., None])[depth_m > 0]
    plane = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]  # plane @ point = 1
    height_m = 1 / np.linalg.norm(plane)
    assert height_m == pytest.approx(1.65, abs=0.03)  # at which KITTI's car carries its cameras
    assert np.std(points @ plane) * height_m < 0.02


def disparity_difference(kitti: StereoPairs, a: int, b: int) -> NDArray[np.float64]:
    """Disparity of pixels of pair a, as its depth predicts it for pair b, minus the one measured there."""
    first, second, k = kitti.read(a), kitti.read(b), kitti.camera
    seen = first.depth_m > 0
    T_b_a: Pose = inverse(second.T_world_camera) @ first.T_world_camera
    points = k.rays()[seen] * first.depth_m[seen][:, None]
    x, y, z = (points @ T_b_a[:3, :3].T + T_b_a[:3, 3]).T
    ahead = z > 1
    u, v = k.fx * x[ahead] / z[ahead] + k.cx, k.fy * y[ahead] / z[ahead] + k.cy
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (columns >= 0) & (columns < k.width) & (rows >= 0) & (rows < k.height)
    measured_m = second.depth_m[rows[inside], columns[inside]].astype(np.float64)
    scale = kitti.baseline_m * k.fx
    both = measured_m > 0
    return scale / z[ahead][inside][both] - scale / measured_m[both]


@pytest.mark.shared_data
def test_pairs_of_the_real_recording_agree_as_sigma_d_says(kitti: StereoPairs) -> None:
    """A pair and the next, 1.2 m further on: poses, calibration and depth fit each other."""
    difference = np.concatenate([disparity_difference(kitti, i, i + 1) for i in (0, 20, 40)])
    assert len(difference) > 500_000
    assert abs(np.median(difference)) < 0.15
    spread = 1.4826 * np.median(np.abs(difference - np.median(difference)))
    assert spread / np.sqrt(2) == pytest.approx(SIGMA_D_PX, rel=0.15)  # the noise of two pairs
    assert (np.abs(difference) > 3).mean() < 0.03
    assert (difference > 3).mean() < 0.01  # a surface that the next pair sees through


def test_a_described_rig_comes_back_as_depth_frames(tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path, NAMES))
    assert (dataset.name, list(dataset.frame_names)) == ("rig", NAMES)
    check_pairs(dataset, [pose(i) for i in range(COUNT)])
    depth, stamps = dataset.notes
    assert f"{SIGMA_D_PX / (BASELINE * CAMERA.fx):.3e}" in depth  # eq. 7: lambda = sigma_d / (b f)
    assert "cam0/*.png and cam1/*.png" in depth
    assert "no stamps" in stamps


def test_what_may_be_left_out_and_what_may_be_added(tmp_path: Path) -> None:
    matching = {"least_disparity": 12.0}
    path = write(tmp_path, NAMES, fy=None, matching=matching, poses="way.log")
    write_log(tmp_path / "way.log", [pose(i) for i in range(COUNT)])
    dataset = open_dataset(path)
    assert isinstance(dataset, StereoPairs)
    assert dataset.camera.fy == dataset.camera.fx
    assert dataset.matching == StereoMatching(least_disparity=12.0)
    assert 0 < dataset.read(0).depth_m.max() <= BASELINE * CAMERA.fx / 12


def test_intrinsics_of_the_caller_change_the_sigma(tmp_path: Path) -> None:
    told = open_dataset(write(tmp_path, NAMES), intrinsics=(50.0, 50.0, 80.0, 30.0), color=False)
    assert told.read(1).color is None
    assert told.camera == PinholeCamera(160, 60, 50.0, 50.0, 80.0, 30.0)
    assert f"{SIGMA_D_PX / (BASELINE * 50.0):.3e}" in told.notes[0]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["100.0", "100.5", "101.0"], [100.0, 100.5, 101.0]),
        ([f"{10**18 + i * 500_000_000}" for i in range(3)], [1e9, 1e9 + 0.5, 1e9 + 1.0]),
    ],
    ids=["seconds", "nanoseconds"],
)
def test_poses_with_stamps_are_interpolated_at_the_images_names(
    tmp_path: Path, names: list[str], stamps: list[float]
) -> None:
    path = write(tmp_path, names)
    times = 0.1, 1.9
    write_stamped(tmp_path / "poses.txt", [stamps[0] + 0.5 * i for i in times], map(pose, times))
    dataset = open_dataset(path, max_time_gap=0.5)
    assert (list(dataset.frame_names), dataset.dropped) == ([names[1]], 2)
    frame = dataset.read(0)
    assert frame.stamp == pytest.approx(stamps[1])
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], pose(1)[:3, 3], atol=1e-6)
    refused(path, "poses.txt: none of 3 stereo pairs", "within 0.1 s")


def test_stamps_in_a_file(tmp_path: Path) -> None:
    path, stamps = write(tmp_path, NAMES, times="times.txt"), [5.0, 5.5, 6.0]
    (tmp_path / "times.txt").write_text("5.0\n5.5\n6.0\n")
    assert [frame.stamp for frame in open_dataset(path)] == stamps
    write_stamped(tmp_path / "poses.txt", stamps, map(pose, range(COUNT)))
    dataset = open_dataset(path)
    assert len(dataset) == 3
    np.testing.assert_allclose(dataset.read(2).T_world_camera, pose(2), atol=1e-6)
    (tmp_path / "times.txt").write_text("5.0")
    refused(path, "times.txt: contains 1 stamps for 3 pairs")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"baseline": None}, "rig.yaml: baseline is missing"),
        ({"poses": None}, "rig.yaml: poses is missing"),
        ({"fx": "wide"}, "rig.yaml: fx must be a number"),
        ({"fx": -1.0}, "both must be positive"),
        ({"baseline": 0.0}, "baseline_m must be a positive"),
        ({"focal": 1.0}, "unknown parameter 'focal'"),
        ({"left": "cam7/*.png"}, "left: no file matches cam7/*.png"),
        ({"right": "cam1/b.png"}, "3 left images but 1 right ones"),
        ({"right": "/cam1/*.png"}, "right: .* is not a relative pattern"),
        ({"poses": "nowhere.txt"}, "nowhere.txt: there is no such file"),
        ({"matching": {"paths": 7}}, "paths must be one of 3, 4, 5, 8"),
        ({"matching": {"block_size": 4}}, "stereo block_size must be odd"),
    ],
)
def test_a_description_that_makes_no_sense(tmp_path: Path, changes: dict, said: str) -> None:
    refused(write(tmp_path, NAMES, **changes), *said.split(" .* "))


@pytest.mark.parametrize("text", ["", "17", "[1, 2", "fx: [1"])
def test_a_file_that_is_no_description(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, NAMES)
    path.write_text(text)
    refused(path, "rig.yaml")


def test_poses_that_do_not_fit(tmp_path: Path) -> None:
    path = write(tmp_path, NAMES)
    write_rows(tmp_path / "poses.txt", [pose(0)])
    refused(path, "poses.txt: contains 1 poses for 3 stereo pairs")
    write_stamped(tmp_path / "poses.txt", [0.0], [pose(0)])
    refused(path, "poses.txt: has stamps, but the images have none")
    refused(path, "depth_scale", depth_scale=1000.0)
