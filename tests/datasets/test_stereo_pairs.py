"""Stereo recordings in KITTI's layout: written here, read back as depth frames, and broken in every way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import Content, row_of, write_image, write_rows, write_seven_scenes
from numpy.typing import NDArray
from refusals import bad_frame, refused
from stereo_rig import BASELINE, CAMERA, COUNT, P0, P1, pairs, poses, write_kitti

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.recorded_noise import with_recorded_noise, with_tuned_noise
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoPairs, stereo_depth
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good recording of three pairs."""
    return write_kitti(tmp_path / "street")


def test_a_recording_comes_back_as_depth_frames(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert isinstance(dataset, StereoPairs)
    assert dataset.name == "street"
    assert dataset.camera == CAMERA
    assert dataset.rig.baseline_m == pytest.approx(BASELINE)
    assert list(dataset.frame_names) == ["000000", "000001", "000002"]
    for i, (frame, pair, pose) in enumerate(zip(dataset, pairs(), poses(), strict=True)):
        assert (frame.name, frame.camera) == (f"{i:06d}", CAMERA)
        assert frame.stamp == pytest.approx(0.1 * i)
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-9)
        np.testing.assert_array_equal(frame.color, np.repeat(pair.left[..., None], 3, axis=2))
        np.testing.assert_array_equal(frame.depth_m, stereo_depth(pair.left, pair.right, dataset.rig))
        found = frame.depth_m > 0
        assert found[pair.visible].mean() > 0.9
        disparity = BASELINE * 100 / frame.depth_m[found]
        assert np.median(np.abs(disparity - pair.disparity[found])) < SIGMA_D_PX


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
    bad_frame(dataset, 1, f"{side}.000001.png: the image is missing")
    assert (dataset.read(2).depth_m > 0).any()


def test_images_of_another_size_are_named(folder: Path) -> None:
    write_image(folder / "image_r/000001.png", np.zeros((60, 150), np.uint8))
    dataset = open_dataset(folder)
    bad_frame(dataset, 1, "image_r", "150 x 60 pixels, the camera 160 x 60")


def test_a_pose_that_is_none_is_named(folder: Path) -> None:
    lines = (folder / "poses.txt").read_text().splitlines()
    lines[1] = row_of(2 * np.eye(4)[:3])
    (folder / "poses.txt").write_text("\n".join(lines))
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
        (f"{row_of(P0)}\n{row_of(P1 + np.eye(3, 4))}", "no rectified pair"),
        (f"{row_of(P0)}\n{row_of(P0)}", "baseline_m must be a positive"),
        (f"{row_of(P1)}\n{row_of(P0)}", "P0 must be at the origin"),
        (f"{row_of(P0)}\n{row_of(P1 + np.eye(3, 4, 2))}", "no rectified pair"),
        (f"{row_of(-P0)}\n{row_of(P1)}", "P0 is not the matrix of a pinhole camera"),
        (f"{row_of(P0 + np.eye(3, 4, 1))}\n{row_of(P1)}", "P0 is not the matrix of a pinhole camera"),
    ],
)
def test_a_bad_calibration_is_refused(folder: Path, text: str, said: str) -> None:
    (folder / "calib.txt").write_text(text)
    with pytest.raises(DatasetError, match=rf"calib\.txt: .*{said}") as caught:
        open_dataset(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["calib.txt", "poses.txt"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    refused(folder, f"{name}: is missing")


def test_other_broken_files_are_named(folder: Path) -> None:
    (folder / "times.txt").write_text("0\n0.1\nsoon")
    refused(folder, "times.txt line 3")
    (folder / "times.txt").write_text("0\n0.1\ninf")
    refused(folder, "times.txt line 3: the stamp is not finite")
    (folder / "times.txt").unlink()
    (folder / "poses.txt").write_text("\n".join(["0 0 0 0 0 0 0 1"] * COUNT))
    refused(folder, "poses.txt: expected a 3 x 4 matrix")
    for side in ("image_l", "image_r"):
        for path in (folder / side).iterdir():
            path.write_bytes(b"")
    refused(folder, "image_l: none of its images can be read")
    for side in ("image_l", "image_r"):
        for path in (folder / side).iterdir():
            path.unlink()
    refused(folder, "no numbered images in image_l or image_r")


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
