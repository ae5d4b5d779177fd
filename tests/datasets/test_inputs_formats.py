"""ScanNet, Replica and Open3D folders, and npz files, written here and read back."""

import json
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    CAMERA,
    INTRINSIC,
    Content,
    K,
    arrays,
    check_frames,
    column_by_column,
    row_of,
    text_of,
    write_image,
    write_log,
    write_npz,
    write_numbered,
    write_replica,
    write_scannet,
)
from refusals import bad_frame, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.session.source import open_source


@pytest.fixture
def content() -> Content:
    return Content()


def test_scannet_and_replica_need_no_note(tmp_path: Path, content: Content) -> None:
    dataset = open_dataset(write_scannet(tmp_path / "scene0000_00", content))
    assert list(dataset.frame_names) == ["0", "5", "10", "15", "20"]
    assert dataset.notes == []
    assert open_dataset(write_replica(tmp_path / "room0", content)).notes == []
    beside = write_replica(tmp_path / "room1" / "own", content, ".")
    check_frames(open_dataset(beside), content, 6553.5, colored=True)


def test_a_folder_is_called_by_its_own_format_and_not_by_its_parts(tmp_path: Path, content: Content) -> None:
    assert format_name(write_scannet(tmp_path / "scene0000_00", content)) == "ScanNet"
    assert format_name(write_replica(tmp_path / "room0", content)) == "Replica (NICE-SLAM)"
    write_replica(tmp_path / "around" / "room1", content)
    assert format_name(tmp_path / "around") == "Replica (NICE-SLAM)"


def test_scannet_leaves_out_what_was_not_tracked(tmp_path: Path, content: Content) -> None:
    folder = write_scannet(tmp_path, content)
    (folder / "pose/5.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (folder / "pose/15.txt").unlink()
    dataset = open_dataset(folder)
    assert (list(dataset.frame_names), dataset.dropped) == (["0", "10", "15", "20"], 1)
    assert "1 of 5 images dropped: tracking was lost" in dataset.notes
    bad_frame(dataset, 2, "15.txt: the pose is missing")
    for path in (folder / "pose").iterdir():
        path.write_text("-inf -inf -inf -inf\n" * 4)
    (folder / "pose/15.txt").write_text("inf")
    refused(folder, "lost in all 5 images")


def test_scannets_own_camera_is_assumed_without_a_file(tmp_path: Path) -> None:
    folder = write_scannet(tmp_path, Content(2, (480, 640)))
    (folder / "intrinsic/intrinsic_depth.txt").unlink()
    dataset = open_dataset(folder)
    assert dataset.camera.fx == pytest.approx(577.87, abs=0.01)
    assert any("assumed the camera of ScanNet" in note for note in dataset.notes)


WIDE = PinholeCamera(40, 30, 35.0, 35.0, 19.5, 14.5)
"""A colour camera 5 cm to the right of the depth camera, in a frame that neither of them is."""


def test_scannets_colours_are_registered_to_depth(tmp_path: Path, content: Content) -> None:
    content.depth = [np.full((12, 16), 2000, np.uint16) for _ in content.depth]
    folder = write_scannet(tmp_path, content, color=True)
    T_base_depth, T_depth_color = content.poses[0], np.eye(4)
    T_depth_color[0, 3] = 0.05
    K_wide = np.array([[WIDE.fx, 0, WIDE.cx, 0], [0, WIDE.fy, WIDE.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    (folder / "intrinsic/intrinsic_color.txt").write_text(text_of(K_wide))
    (folder / "intrinsic/extrinsic_depth.txt").write_text(text_of(T_base_depth))
    (folder / "intrinsic/extrinsic_color.txt").write_text(text_of(T_base_depth @ T_depth_color))
    across = np.broadcast_to(np.arange(40, dtype=np.uint8), (30, 40))
    for path in (folder / "color").iterdir():
        write_image(path, np.stack([5 * across, across, across], axis=2))
    dataset = open_dataset(folder)
    assert dataset.notes == []
    color = dataset.read(0).color
    # On a wall in 2 m the colour camera sees the depth camera's pixel u at this column.
    u = (CAMERA.rays()[0, :, 0] * 2.0 - 0.05) / 2.0 * WIDE.fx + WIDE.cx
    inside = (u >= 0) & (u <= 39)
    np.testing.assert_allclose(color[6, inside, 0], 5 * u[inside], atol=1)
    assert not color[6, ~inside].any()
    assert open_dataset(folder, color=False).read(0).color is None


def test_scannets_colours_without_their_camera(tmp_path: Path, content: Content) -> None:
    folder = write_scannet(tmp_path, content, color=True)
    (folder / "color/5.png").unlink()
    assert [frame.color is None for frame in open_dataset(folder)] == [False, True, False, False, False]
    K_large = np.diag([1170.0, 1170.0, 1.0, 1.0])
    K_large[:2, 2] = 647.5, 483.5
    (folder / "intrinsic/intrinsic_color.txt").write_text(text_of(K_large))
    refused(folder, "principal point 647.5 483.5, but images have 16 x 12")
    (folder / "intrinsic/intrinsic_color.txt").unlink()
    dataset = open_dataset(folder)
    assert dataset.read(0).color is None
    assert [note for note in dataset.notes if "intrinsic_color.txt" in note]


def test_replica_that_is_not_whole(tmp_path: Path) -> None:
    content = Content(2, (680, 1200))
    folder = write_replica(tmp_path, content, ".")
    (folder / "cam_params.json").write_text('{"camera": {"w": 16}}')
    refused(folder, "cam_params.json: camera needs the numbers w, h")
    (folder / "cam_params.json").write_text("{")
    refused(folder, "cam_params.json")
    (folder / "cam_params.json").unlink()
    assert any("assumed the camera of Replica" in note for note in open_dataset(folder).notes)
    (folder / "traj.txt").write_text(row_of(np.eye(4)))
    refused(folder, "one for each depth image, found 1 poses")
    (folder / "traj.txt").unlink()
    refused(folder, "traj.txt: is missing")


@pytest.mark.parametrize("kind", ["PinholeCameraTrajectory", "PoseGraph"])
def test_open3d_with_a_json(tmp_path: Path, content: Content, kind: str) -> None:
    folder = write_numbered(tmp_path, content, place="depth")
    if kind == "PoseGraph":
        values: dict = {"nodes": [{"pose": column_by_column(pose)} for pose in content.poses]}
    else:
        (folder / "camera.txt").unlink()
        extrinsics = [column_by_column(inverse(pose)) for pose in content.poses]
        values = {"parameters": [{"extrinsic": e, "intrinsic": INTRINSIC} for e in extrinsics]}
    (folder / "trajectory.json").write_text(json.dumps({"class_name": kind, **values}))
    dataset = open_dataset(folder)
    check_frames(dataset, content, 1000.0, colored=True)
    (note,) = dataset.notes
    assert note.startswith("depth: 1000 steps per metre (assumed as Redwood has it)")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("trajectory.json", '{"class_name": "PoseGraph", "nodes": []}', "contains no pose"),
        ("trajectory.json", '{"class_name": "PoseGraph", "nodes": [{"pose": [1]}]}', "entry 0: needs the 16"),
        ("trajectory.json", '{"class_name": "Mesh"}', "without a trajectory"),
        ("trajectory.json", "[1]", "without a trajectory"),
        ("camera_intrinsic.json", "[", "not valid JSON"),
        ("camera_intrinsic.json", '{"width": 16, "height": 12}', "an intrinsic needs width"),
        (
            "camera_intrinsic.json",
            '{"width": 0, "height": 12, "intrinsic_matrix": [1,0,0,0,1,0,1,1,1]}',
            "at least 1",
        ),
    ],
)
def test_open3d_files_that_make_no_sense(
    tmp_path: Path, content: Content, name: str, text: str, said: str
) -> None:
    folder = write_numbered(tmp_path, content, place="depth")
    (folder / "camera.txt").unlink()
    if name.startswith("camera"):
        write_log(folder / "trajectory.log", content.poses)
    (folder / name).write_text(text)
    refused(folder, said)


def test_npz(tmp_path: Path, content: Content) -> None:
    path = write_npz(tmp_path / "walk.npz", arrays(content))
    dataset = open_dataset(path)
    check_frames(dataset, content, 1000.0, colored=True)
    assert [frame.stamp for frame in dataset] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert list(dataset.frame_names) == [f"walk-{i:06d}" for i in range(5)]
    assert open_dataset(path, color=False).read(0).color is None


def test_npz_of_steps_and_numbers(tmp_path: Path, content: Content) -> None:
    values = {name: value for name, value in arrays(content).items() if name in ("depth_m", "T_world_camera")}
    values |= {"depth_m": np.stack(content.depth), "T_world_camera": values["T_world_camera"][:, :3]}
    values |= {name: np.array(getattr(CAMERA, name)) for name in ("fx", "fy", "cx", "cy")}
    path = write_npz(tmp_path / "walk.npz", values)
    refused(path, "needs depth_scale")
    check_frames(open_dataset(path, depth_scale=2000.0), content, 2000.0)
    scaled = write_npz(tmp_path / "scaled.npz", {**values, "depth_scale": np.array(4000.0)})
    check_frames(open_dataset(scaled), content, 4000.0)


def test_a_folder_of_npz_is_one_sequence(tmp_path: Path, content: Content) -> None:
    values = arrays(content)
    both = {"K": K, **{name: values[name][:2] for name in ("depth_m", "T_world_camera", "stamp", "color")}}
    write_npz(tmp_path / "a.npz", both)
    for i in (2, 3, 4):
        one = {name: values[name][i] for name in ("depth_m", "T_world_camera", "stamp", "color")}
        write_npz(tmp_path / f"b{i}.npz", {"K": K, **one})
    dataset = open_dataset(tmp_path)
    assert list(dataset.frame_names) == ["a-000000", "a-000001", "b2", "b3", "b4"]
    check_frames(dataset, content, 1000.0, colored=True)
    write_npz(tmp_path / "c.npz", {**both, "K": np.diag([1.2, 1.2, 1]) @ K})
    other = open_dataset(tmp_path).read(5).camera
    assert (other.fx, other.cy) == pytest.approx((1.2 * CAMERA.fx, 1.2 * CAMERA.cy))


def test_frames_without_stamps_are_a_second_apart(tmp_path: Path, content: Content) -> None:
    """Also from one file of a folder to the next."""
    values = {name: value for name, value in arrays(content).items() if name != "stamp"}
    for name, part in (("a", slice(0, 2)), ("b", slice(2, 5))):
        few = {key: values[key][part] for key in ("depth_m", "T_world_camera", "color")}
        write_npz(tmp_path / f"{name}.npz", {"K": K, **few})
    assert [frame.stamp for frame in open_dataset(tmp_path)] == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_missing_depth_is_zero(tmp_path: Path, content: Content) -> None:
    values = arrays(content)
    values["depth_m"][0, 0, :3] = (np.nan, np.inf, -1)
    depth_m = open_dataset(write_npz(tmp_path / "walk.npz", values)).read(0).depth_m
    np.testing.assert_array_equal(depth_m[0, :3], 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"depth_m": None}, "depth_m is missing"),
        ({"T_world_camera": None}, "T_world_camera is missing"),
        ({"K": None}, "needs K (3, 3), or fx, fy, cx, cy; fx, fy, cx, cy missing"),
        ({"K": np.eye(4)}, "K is (4, 4)"),
        ({"K": np.zeros((3, 3))}, "its intrinsics are all zero; --camera fx,fy,cx,cy sets them"),
        ({"K": np.diag([0.0, 1.0, 1.0])}, "K: camera focal lengths 0.0, 1.0: both must be positive"),
        ({"K": K + 0.5 * np.eye(3, k=1) * (np.arange(3) == 1)}, "K: the matrix has skew 0.5"),
        ({"stamp": np.array([0.0, 0.1, np.nan, 0.3, 0.4])}, "stamp of frame 2 is nan"),
        ({"T_world_camera": np.zeros((4, 4, 4))}, "T_world_camera is (4, 4, 4); expected (5, 4, 4)"),
        ({"T_world_camera": np.zeros(3)}, "T_world_camera is (3,)"),
        ({"depth_m": np.zeros((5, 12))}, None),
        ({"depth_m": np.zeros((5, 12, 16), complex)}, "depth_m is complex128"),
        ({"stamp": np.zeros(4)}, "stamp is (4,)"),
        ({"color": np.zeros((5, 12, 16, 3))}, "color is float64"),
        ({"depth_m": np.array(["deep"])}, "depth_m is <U4"),
        ({"T_world_camera": np.array([None] * 5)}, "T_world_camera"),
        ({"depth_scale": np.array(0.0)}, "depth_scale must be a positive number"),
    ],
)
def test_fields_that_make_no_sense_are_named(
    tmp_path: Path, content: Content, change: dict, said: str | None
) -> None:
    values = {name: value for name, value in {**arrays(content), **change}.items() if value is not None}
    path = write_npz(tmp_path / "walk.npz", values)
    text = refused(path)
    assert text.startswith(str(path))
    assert said is None or said in text


def test_a_broken_pose_of_an_npz_is_one_frames(tmp_path: Path, content: Content) -> None:
    values = arrays(content)
    values["T_world_camera"][1] *= 2
    dataset = open_dataset(write_npz(tmp_path / "walk.npz", values))
    bad_frame(dataset, 1, "walk.npz: T_world_camera")
    assert (dataset.read(2).depth_m > 0).any()


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_damaged_npz_is_named(tmp_path: Path, content: Content, share: float) -> None:
    path = write_npz(tmp_path / "walk.npz", arrays(content))
    data = bytearray(path.read_bytes())
    path.write_bytes(data[: int(len(data) * share)])
    refused(path, str(path))
    large = {"depth_m": np.ones((5, 60, 80)), "T_world_camera": np.stack(content.poses)}
    large["K"] = np.diag([5, 5, 1]) @ K
    np.savez(path, **large)  # type: ignore[arg-type]
    data = bytearray(path.read_bytes())
    position = data.find(b"depth_m.npy") + 50_000
    data[position : position + 40] = bytes(40)
    path.write_bytes(data)
    bad_frame(open_dataset(path), 0, "walk-000000:", "walk.npz: depth_m cannot be read")


def test_other_files_are_not_taken_for_frames(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "other.npz", {"values": np.zeros(3)})
    refused(path, "contains values, but not depth_m, T_world_camera and K")
    refused(tmp_path / "nowhere.npz", "no such folder or file")
    frames = write_npz(tmp_path / "frames.npz", {"depth_m": np.zeros((3, 4))})
    refused(f"{frames}?depth=/camera", "takes no options after a question mark")


def test_live_takes_frames_for_frames_and_not_for_a_map(
    tmp_path: Path, content: Content, one_backend: str
) -> None:
    from taichi_mrf.config.schema import Config

    path = write_npz(tmp_path / "walk.npz", arrays(content))
    source, _ = open_source(str(path), Config(), every=1, limit=None, speed=0.0, loop=False)
    assert source.new_replay is not None
    assert source.new_replay().frames == content.count


@pytest.mark.shared_data
def test_the_coffin_scene_is_such_a_file(shared_data: Path) -> None:
    dataset = open_dataset(shared_data / "coffin_world" / "clean_depth.npz")
    frame = dataset.read(len(dataset) - 1)
    assert 0.1 < np.median(frame.depth_m[frame.depth_m > 0]) < 10
    assert frame.depth_m.shape == dataset.camera.shape
