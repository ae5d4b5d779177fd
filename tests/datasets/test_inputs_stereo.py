"""Rectified stereo pairs that a YAML file describes: written here, read back, and broken in every way."""

from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import stamped_line, write_log, write_rows
from refusals import refused
from stereo_rig import BASELINE, CAMERA, COUNT, pairs, pose, write

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, StereoPairs, stereo_depth
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera

NAMES = ["a", "b", "c"]


def test_a_described_rig_comes_back_as_depth_frames(tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path, NAMES))
    assert isinstance(dataset, StereoPairs)
    assert (dataset.camera, dataset.baseline_m, dataset.name) == (CAMERA, BASELINE, "rig")
    for i, (frame, pair) in enumerate(zip(dataset, pairs(), strict=True)):
        np.testing.assert_array_equal(frame.depth_m, stereo_depth(pair.left, pair.right, dataset.rig))
        np.testing.assert_allclose(frame.T_world_camera, pose(i), atol=1e-9)
        found = frame.depth_m > 0
        disparity = BASELINE * CAMERA.fx / frame.depth_m[found]
        assert np.median(np.abs(disparity - pair.disparity[found])) < SIGMA_D_PX
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
    told = open_dataset(write(tmp_path, NAMES), intrinsics=(50.0, 50.0, 80.0, 30.0))
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
    lines = [stamped_line(stamps[0] + 0.5 * i, np.array(pose(i))) for i in (0.1, 1.9)]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    dataset = open_dataset(path, max_time_gap=0.5)
    assert (list(dataset.frame_names), dataset.dropped) == ([names[1]], 2)
    frame = dataset.read(0)
    assert frame.stamp == pytest.approx(stamps[1])
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], pose(1)[:3, 3], atol=1e-6)
    refused(path, "poses.txt: none of 3 stereo pairs", "within 0.1 s")


def test_stamps_in_a_file(tmp_path: Path) -> None:
    path = write(tmp_path, NAMES, times="times.txt")
    (tmp_path / "times.txt").write_text("5.0\n5.5\n6.0\n")
    assert [frame.stamp for frame in open_dataset(path)] == [5.0, 5.5, 6.0]
    (tmp_path / "poses.txt").write_text("\n".join(stamped_line(5.0 + 0.5 * i, pose(i)) for i in range(3)))
    dataset = open_dataset(path)
    assert len(dataset) == 3
    np.testing.assert_allclose(dataset.read(2).T_world_camera, pose(2), atol=1e-6)
    (tmp_path / "times.txt").write_text("5.0")
    refused(path, "times.txt: contains 1 stamps for 3 pairs")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"baseline": None}, r"rig\.yaml: baseline is missing"),
        ({"poses": None}, r"rig\.yaml: poses is missing"),
        ({"fx": "wide"}, r"rig\.yaml: fx must be a number"),
        ({"fx": -1.0}, "both must be positive"),
        ({"baseline": 0.0}, "baseline_m must be a positive"),
        ({"focal": 1.0}, "unknown parameter 'focal'"),
        ({"left": "cam7/*.png"}, r"left: no file matches cam7/\*\.png"),
        ({"right": "cam1/b.png"}, "3 left images but 1 right ones"),
        ({"right": "/cam1/*.png"}, "right: .* is not a relative pattern"),
        ({"poses": "nowhere.txt"}, r"nowhere\.txt: there is no such file"),
        ({"matching": {"paths": 7}}, "paths must be one of 3, 4, 5, 8"),
        ({"matching": {"block_size": 4}}, "stereo block_size must be odd"),
    ],
)
def test_a_description_that_makes_no_sense(tmp_path: Path, changes: dict, said: str) -> None:
    path = write(tmp_path, NAMES, **changes)
    with pytest.raises(DatasetError, match=said) as caught:
        open_dataset(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "17", "[1, 2", "fx: [1"])
def test_a_file_that_is_no_description(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, NAMES)
    path.write_text(text)
    refused(path, "rig.yaml")


def test_poses_that_do_not_fit(tmp_path: Path) -> None:
    path = write(tmp_path, NAMES)
    write_rows(tmp_path / "poses.txt", [pose(0)])
    refused(path, "poses.txt: contains 1 poses for 3 stereo pairs")
    (tmp_path / "poses.txt").write_text(stamped_line(0.0, pose(0)))
    refused(path, "poses.txt: has stamps, but the images have none")
    refused(path, "depth_scale", depth_scale=1000.0)
