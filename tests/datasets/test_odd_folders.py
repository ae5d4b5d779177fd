"""Folders that are not as their formats' authors wrote them: paths of other computers, other names, lost
poses, colours of another size. All are read as they should be, or refused with the remedy."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets_recordings import (
    Content,
    K,
    check_frames,
    row_of,
    stamped_line,
    write_image,
    write_log,
    write_npz,
    write_numbered,
    write_rows,
    write_scannet,
    write_seven_scenes,
    write_tum,
)
from refusals import refused

from taichi_mrf.datasets import Dataset, open_dataset

CONTENT = Content()


def check(dataset: Dataset, steps: float, numbers: range = range(CONTENT.count)) -> None:
    assert len(dataset) == len(numbers)
    for frame, i in zip(dataset, numbers, strict=True):
        np.testing.assert_allclose(frame.depth_m, CONTENT.depth[i] / np.float32(steps))
        np.testing.assert_allclose(frame.T_world_camera, CONTENT.poses[i], atol=1e-5)


def listed(change: Callable[[str], str]) -> Callable[[Path], None]:
    """Change the lines of the list of depth images."""

    def apply(folder: Path) -> None:
        path = folder / "depth.txt"
        path.write_text("\n".join(map(change, path.read_text().splitlines())))

    return apply


def other_name(folder: Path) -> None:
    (folder / "groundtruth.txt").rename(folder / "CameraTrajectory.txt")


def lost_row(folder: Path) -> None:
    path = folder / "groundtruth.txt"
    path.write_text(path.read_text() + "\n" + " ".join(["nan"] * 8))


TUM: dict[str, Callable[[Path], object]] = {
    "backslashes": listed(lambda line: line.replace("/", "\\")),
    "of Windows": listed(lambda line: line.replace("depth/", "C:\\my data\\depth\\")),
    "of another computer": listed(lambda line: line.replace("depth/", "/home/ann/run 1/depth/")),
    "commas": listed(lambda line: line.replace(" ", ",")),
    "names of columns": listed(lambda line: line.replace("# stamp", "timestamp")),
    "no list": lambda folder: (folder / "depth.txt").unlink(),
    "poses of another name": other_name,
    "a row of NaN": lost_row,
}


@pytest.mark.parametrize("case", TUM)
def test_lists_of_other_computers_and_programs(tmp_path: Path, case: str) -> None:
    TUM[case](write_tum(tmp_path, CONTENT))
    check(open_dataset(tmp_path), 5000.0)


def prefixed(name: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for path in (folder / "depth").iterdir():
            path.rename(path.with_name(name.format(path.stem)))

    return apply


def poses(line: Callable[[int], str]) -> Callable[[Path], object]:
    text = "\n".join(line(i) for i in range(CONTENT.count))
    return lambda folder: (folder / "poses.txt").write_text(text)


NUMBERED: dict[str, Callable[[Path], object]] = {
    "PNG": prefixed("{}.PNG"),
    "depth_N": prefixed("depth_{}.png"),
    "frameN": prefixed("frame{}.png"),
    "decimal commas": poses(lambda i: row_of(CONTENT.poses[i][:3]).replace(".", ",")),
    "numbers of frames": poses(lambda i: f"{i} {row_of(CONTENT.poses[i][:3])}"),
    "numbers of frames and 4 x 4": poses(lambda i: f"{i} {row_of(CONTENT.poses[i])}"),
    "blank lines": poses(lambda i: row_of(CONTENT.poses[i][:3]) + "\n"),
    "times": poses(lambda i: stamped_line(0.1 * i, CONTENT.poses[i])),
    "files of macOS": lambda folder: (folder / "depth" / "._00001.png").write_bytes(b"\0\5\x16\7"),
}


@pytest.mark.parametrize("case", NUMBERED)
def test_numbered_images_and_poses_in_other_ways(tmp_path: Path, case: str) -> None:
    write_numbered(tmp_path, CONTENT, place="depth")
    write_rows(tmp_path / "poses.txt", CONTENT.poses)
    NUMBERED[case](tmp_path)
    check(open_dataset(tmp_path, depth_scale=1000.0), 1000.0)


def test_images_that_numbered_poses_do_not_name_are_dropped(tmp_path: Path) -> None:
    write_numbered(tmp_path, CONTENT)
    lines = [f"{i} {row_of(CONTENT.poses[i][:3])}" for i in (2, 3)]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    dataset = open_dataset(tmp_path, depth_scale=1000.0)
    check(dataset, 1000.0, range(2, 4))
    assert dataset.dropped == 3


def lost_in(folder: Path, name: str) -> Path:
    (folder / name).write_text("\n".join(["-1.#IND 0 0 0"] * 4))
    return folder


def npz(folder: Path) -> Path:
    T = np.stack(CONTENT.poses)
    T[0] = np.nan
    depth_m = np.stack(CONTENT.depth) / np.float32(1000)
    write_npz(folder / "walk.npz", {"depth_m": depth_m, "T_world_camera": T, "K": np.diag([14.0, 14.0, 1.0])})
    return folder / "walk.npz"


def numbered(folder: Path) -> Path:
    write_numbered(folder, CONTENT)
    lines = [row_of(pose[:3]) for pose in CONTENT.poses]
    (folder / "poses.txt").write_text("\n".join([" ".join(["nan"] * 12), *lines[1:]]))
    return folder


@pytest.mark.parametrize(
    "write",
    [
        lambda f: lost_in(write_seven_scenes(f, CONTENT), "frame-000000.pose.txt"),
        lambda f: lost_in(write_scannet(f, CONTENT), "pose/0.txt"),
        npz,
        numbered,
    ],
)
def test_images_whose_pose_was_lost_are_dropped_in_every_format(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    dataset = open_dataset(
        write(tmp_path), depth_scale=None if write is npz else 1000.0, intrinsics=(14.0, 14.0, 7.5, 5.5)
    )
    check(dataset, 1000.0, range(1, CONTENT.count))
    assert dataset.dropped == 1
    assert any("tracking was lost" in note for note in dataset.notes)


def test_larger_colours_of_the_same_view_are_scaled(tmp_path: Path) -> None:
    write_numbered(tmp_path, CONTENT, place="depth")
    write_rows(tmp_path / "poses.txt", CONTENT.poses)
    for i, color in enumerate(CONTENT.color):
        large = cv2.resize(color, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
        write_image(tmp_path / "color" / f"{i:05d}.png", large)
    np.testing.assert_array_equal(open_dataset(tmp_path).read(1).color, CONTENT.color[1])


def test_the_only_recording_in_a_folder_is_opened(tmp_path: Path) -> None:
    write_tum(tmp_path / "walk" / "walk", CONTENT)
    (tmp_path / "walk" / "README.md").write_text("read me")
    (tmp_path / "__MACOSX").mkdir()
    dataset = open_dataset(tmp_path)
    check(dataset, 5000.0)
    assert dataset.notes[0] == f"the recording is {tmp_path / 'walk' / 'walk'}"


@pytest.mark.parametrize(
    ("poses", "camera"),
    [("trajectory.log", "camera_intrinsic.json"), ("scene/trajectory.log", "intrinsic.json")],
)
@pytest.mark.parametrize("order", ["columns", "rows, as by hand"])
def test_a_trajectory_and_intrinsics_of_open3d_are_found(
    tmp_path: Path, poses: str, camera: str, order: str
) -> None:
    """Beside the images, or where its reconstruction system writes them."""
    write_numbered(tmp_path, CONTENT, place="depth")
    (tmp_path / "camera.txt").unlink()
    (tmp_path / poses).parent.mkdir(exist_ok=True)
    write_log(tmp_path / poses, CONTENT.poses)
    matrix = K.T if order == "columns" else K
    numbers = {"width": 16, "height": 12, "intrinsic_matrix": matrix.reshape(-1).tolist()}
    (tmp_path / camera).write_text(json.dumps(numbers))
    check_frames(open_dataset(tmp_path), CONTENT, 1000.0, colored=True)


def jsons(folder: Path) -> None:
    for i in range(CONTENT.count):
        (folder / f"frame_{i:05d}.json").write_text(json.dumps({"cameraPoseARFrame": [1.0] * 16}))


def npy(folder: Path) -> None:
    shutil.move(folder / "depth", folder / "rgb")
    (folder / "depth").mkdir()
    np.save(folder / "depth/0.npy", CONTENT.depth[0] / 1000)


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "other poses": (
        poses(lambda i: stamped_line(0.1 * i, np.eye(4)) if i else ""),
        "cannot be matched with",
    ),
    "JSON": (jsons, "5 files such as frame_00000.json may hold.*--poses-are opengl"),
    "nerfstudio": (lambda f: (f / "transforms.json").write_text("{}"), "transforms.json.*--poses-are opengl"),
    "depth as npy": (npy, "unsupported format (0.npy"),
    "raw KITTI": (
        lambda f: (shutil.rmtree(f / "depth"), (f / "oxts").mkdir()),
        "raw recording of KITTI's, whose oxts/ holds latitudes",
    ),
    "angles": (
        lambda f: (f / "groundtruth.csv").write_text("1,2,3,4,.1,.2,.3"),
        "no quaternion; angles are not read; --poses FILE",
    ),
    "rtabmap-export": (
        lambda f: shutil.move(f / "depth", f / "rtabmap_depth"),
        "is output of rtabmap-export; pass the database itself",
    ),
    "broken poses": (
        lambda f: (f / "poses.txt").write_text("1 2 3 4 5"),
        "without a trajectory.*line 1: 5 numbers",
    ),
    "JPEG": (
        lambda f: (
            shutil.rmtree(f / "depth"),
            poses(lambda i: "0 " * 12)(f),
            write_image(f / "rgb/1.jpg", CONTENT.color[0]),
        ),
        "but no depth image",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_missing_is_named_with_the_remedy(tmp_path: Path, case: str) -> None:
    write_numbered(tmp_path, CONTENT, place="depth")
    shutil.rmtree(tmp_path / "color")
    change, words = REFUSED[case]
    change(tmp_path)
    refused(tmp_path, *words.split(".*"))


@pytest.mark.parametrize("scale", [None, 1.0, 1000.0])
def test_floats_in_millimetres_are_refused_unless_the_scale_is_given(
    tmp_path: Path, scale: float | None
) -> None:
    depth = np.stack(CONTENT.depth).astype(np.float32)
    K = np.diag([14.0, 14.0, 1.0])
    write_npz(tmp_path / "a.npz", {"depth_m": depth, "T_world_camera": np.stack(CONTENT.poses), "K": K})
    if scale is None:
        refused(
            tmp_path / "a.npz",
            "too much for metres: pass --depth-scale 1000",
            intrinsics=(14.0, 14.0, 7.5, 5.5),
        )
    else:
        check(open_dataset(tmp_path / "a.npz", depth_scale=scale, intrinsics=(14.0, 14.0, 7.5, 5.5)), scale)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("out/map.npz", "map.npz: is a saved map, not a recording: .* live, .* read map.npz"),
        ("out", "out: is a saved map, not a recording: .* live, .* read map.npz"),
        ("room.zarr", "room.zarr: is a saved map, .* info, export and diff read it"),
    ],
)
def test_a_saved_map_is_no_recording(tmp_path: Path, name: str, words: str) -> None:
    for folder in ("out", "room.zarr"):
        (tmp_path / folder).mkdir()
    (tmp_path / "room.zarr/zarr.json").write_text("{}")
    np.savez(tmp_path / "out/map.npz", format=np.array(2), keyframe_ids=np.zeros(0, int))
    refused(tmp_path / name, *words.split(" .* "))
