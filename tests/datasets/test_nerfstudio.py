"""Recordings in nerfstudio's layout, as Polycam, Record3D and others export them: cameras, poses, units."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets_recordings import CAMERA, Content, check_frames, write_image, write_nerfstudio
from refusals import bad_frame, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import FrameError

CONTENT = Content(3)


def changed(folder: Path, number: int, **entries: object) -> Path:
    """The recording with other entries of one frame; None leaves one out."""
    path = folder / "transforms.json"
    values = json.loads(path.read_text())
    frame = values["frames"][number] | entries
    values["frames"][number] = {name: value for name, value in frame.items() if value is not None}
    path.write_text(json.dumps(values))
    return folder


def test_paths_of_windows_and_another_order_make_no_difference(tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "walk", CONTENT)
    text = (folder / "transforms.json").read_text()
    values = json.loads(text.replace("depth/", "depth\\\\").replace("images/", ".\\\\images\\\\"))
    values["frames"].reverse()
    (folder / "transforms.json").write_text(json.dumps(values))
    check_frames(open_dataset(folder), CONTENT, 1000.0, colored=True)


def test_frames_may_have_their_own_cameras(tmp_path: Path) -> None:
    folder = changed(write_nerfstudio(tmp_path / "walk", CONTENT), 1, fl_x=32.0, fl_y=34.0, cx=14.5)
    cameras = [frame.camera for frame in open_dataset(folder)]
    assert (cameras[0], cameras[2]) == (CAMERA, CAMERA)
    assert (cameras[1].fx, cameras[1].fy, cameras[1].cx, cameras[1].cy) == (16.0, 17.0, 7.0, 5.5)


def test_an_angle_stands_for_the_focal_length(tmp_path: Path) -> None:
    angle = 2 * np.arctan(16 / 28)
    folder = write_nerfstudio(
        tmp_path / "walk", CONTENT, fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=angle
    )
    camera = open_dataset(folder).camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [14, 14, 7.75, 5.75])


def test_the_unit_is_the_one_that_is_stated(tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "walk", CONTENT, depth_unit_scale_factor=2e-4)
    check_frames(open_dataset(folder), CONTENT, 5000.0, colored=True)


@pytest.mark.parametrize(
    ("dtype", "stored", "factor"),
    [
        ("<f4", 1e-3, None),
        (">f8", 1e-3, 1.0),
        ("<f4", 1.0, 1e-3),
        ("<u2", 1.0, None),
        ("<u2", 5.0, 2e-4),
        ("<i4", 5.0, 2e-4),
    ],
)
@pytest.mark.parametrize("channels", [(), (1,)])
def test_depth_may_be_arrays(
    dtype: str, stored: float, factor: float | None, channels: tuple[int, ...], tmp_path: Path
) -> None:
    """``stored`` is what a millimetre is in the arrays."""
    folder = write_nerfstudio(tmp_path / "walk", CONTENT, depth_unit_scale_factor=factor)
    for number, depth in enumerate(CONTENT.depth):
        path = folder / f"depth/frame_{number + 1:05d}.png"
        path.unlink()
        array = (depth.astype(np.float64) * stored).astype(dtype)
        np.save(path.with_suffix(".npy"), array.reshape(*array.shape, *channels))
        changed(folder, number, depth_file_path=f"depth/{path.stem}.npy")
    dataset = open_dataset(folder)
    check_frames(dataset, CONTENT, 1000.0, colored=True)
    assert dataset.misfit() is None


@pytest.mark.parametrize(
    ("array", "problem"),
    [
        (np.zeros((12, 16, 3), np.float32), r"found float32 \(12, 16, 3\)"),
        (np.zeros((12, 16), complex), "found complex128"),
        (np.zeros((9, 16), np.float32), "the image has 16 x 9 pixels, the camera 16 x 12"),
        (np.array([[{}]], object), "not an array of plain values"),
        (b"\x93NUMPY", "not a readable array"),
        (None, "there is no such file"),
    ],
)
def test_an_array_that_is_no_depth_image_spoils_its_frame_alone(
    array: Any, problem: str, tmp_path: Path
) -> None:
    folder = changed(write_nerfstudio(tmp_path / "walk", CONTENT), 1, depth_file_path="depth/frame_00002.npy")
    if isinstance(array, bytes):
        (folder / "depth/frame_00002.npy").write_bytes(array)
    elif array is not None:
        np.save(folder / "depth/frame_00002.npy", array, allow_pickle=True)
    dataset = open_dataset(folder)
    with pytest.raises(FrameError, match=problem):
        dataset.read(1)
    dataset.read(2)


@pytest.mark.parametrize("scaled", ["applied_scale", "applied_transform"])
def test_a_scale_of_the_world_is_undone(scaled: str, tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "walk", CONTENT)
    values = json.loads((folder / "transforms.json").read_text())
    swapped = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    applied = np.eye(4)
    applied[:3, :3] = swapped * (3.0 if scaled == "applied_transform" else 1.0)
    for frame in values["frames"]:
        matrix = applied @ np.array(frame["transform_matrix"])
        if scaled == "applied_scale":
            matrix[:3, 3] *= 3.0
        frame["transform_matrix"] = matrix.tolist()
    values["applied_transform"] = applied[:3].tolist()
    if scaled == "applied_scale":
        values["applied_scale"] = 3.0
    (folder / "transforms.json").write_text(json.dumps(values))
    for i, frame in enumerate(open_dataset(folder)):
        expected = np.eye(4)
        expected[:3] = swapped @ CONTENT.poses[i][:3]
        np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-9)


def test_frames_without_depth_are_left_out(tmp_path: Path) -> None:
    folder = changed(write_nerfstudio(tmp_path / "walk", CONTENT), 0, depth_file_path=None)
    dataset = open_dataset(folder)
    assert (list(dataset.frame_names), dataset.dropped) == (["frame_00002", "frame_00003"], 1)
    assert dataset.notes[0] == "1 of 3 images dropped: transforms.json names no depth image for them"


@pytest.mark.parametrize(("turned", "quarters"), [("turned-left", 1), ("turned-right", 3)])
def test_turned_images_of_a_camera_that_is_not_are_read_with_the_flag_and_refused_without(
    turned: str, quarters: int, tmp_path: Path
) -> None:
    """``w`` and ``h`` are the sensor's, of twice the pixels of depth along each side."""
    folder = write_nerfstudio(tmp_path / "walk", CONTENT)
    for number, depth in enumerate(CONTENT.depth):
        stored = np.ascontiguousarray(np.rot90(depth, quarters))
        write_image(folder / f"depth/frame_{number + 1:05d}.png", stored)
    refused(folder, "depth of 12 x 16 pixels", "--image-is turned-left")
    check_frames(open_dataset(folder, image_is=turned, color=False), CONTENT, 1000.0)


def test_a_lens_is_undone(tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "walk", CONTENT, k1=0.5, p2=0.01)
    plain = open_dataset(folder, undistort=(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(plain.read(0).depth_m, CONTENT.depth[0] / np.float32(1000), rtol=1e-6)
    assert (open_dataset(folder).read(0).depth_m != plain.read(0).depth_m).any()


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ({"fl_x": None}, "frames[0]: has neither fl_x nor camera_angle_x"),
        ({"fl_x": 0}, "frames[0]: fl_x must be positive"),
        ({"w": "wide"}, "frames[0]: w is wide, not a number"),
        ({"h": 30}, "depth of 16 x 12 pixels has other proportions than w and h, 32 x 30"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model OPENCV_FISHEYE is not supported"),
        ({"applied_transform": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "the poses are deformed"),
        ({"depth_unit_scale_factor": -1}, "depth_unit_scale_factor must be positive"),
    ],
)
def test_entries_that_are_wrong_are_named(entries: dict[str, Any], problem: str, tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "walk", CONTENT, **entries)
    refused(folder, "transforms.json", problem)


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ({"depth_file_path": 7}, "frames[1]: a path must be text"),
        ({"k1": 0.2}, "its frames have different lenses"),
    ],
)
def test_frames_that_are_wrong_are_named(entries: dict[str, Any], problem: str, tmp_path: Path) -> None:
    folder = changed(write_nerfstudio(tmp_path / "walk", CONTENT), 1, **entries)
    refused(folder, "transforms.json", problem)


@pytest.mark.parametrize("matrix", [[[1, 2], [3, 4]], (2 * np.eye(4)).tolist(), None])
def test_a_pose_that_is_wrong_spoils_its_frame_alone(matrix: object, tmp_path: Path) -> None:
    folder = changed(write_nerfstudio(tmp_path / "walk", CONTENT), 1, transform_matrix=matrix)
    dataset = open_dataset(folder)
    bad_frame(dataset, 1, "transforms.json: frames[1]")
    dataset.read(2)
