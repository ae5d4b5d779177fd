"""Sources of poses: the files that they are read from, files that change, and which pose is whose."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    Content,
    stamped_line,
    write_log,
    write_numbered,
    write_rows,
    write_stamped,
    write_tum,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from inputs_bags import (
    COUNT,
    FRAME,
    START,
    Bag,
    Kind,
    Make,
    T_body_camera,
    images,
    mounted,
    moving_tf,
    plain,
    stamp,
    world_body,
    writing,
)
from refusals import refusal, refused
from scipy.spatial.transform import Rotation
from sliding_camera import CAMERA, sequence

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.pose_sources.base import (
    SETTLES_S,
    STAYS_BROKEN_S,
    CallbackPoses,
    ChangedPoses,
    WatchedFile,
    open_pose_source,
)
from taichi_mrf.datasets.pose_sources.graph_file import PoseGraph, read_pose_graph, write_pose_graph
from taichi_mrf.datasets.pose_sources.posed import FramePoses, PosedFrames, open_posed, posed_by
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose

RANDOM = np.random.default_rng(7)


def pose(rotation: Rotation | None = None, *position: float) -> Pose:
    T = np.eye(4)
    T[:3, :3] = (rotation or Rotation.random(random_state=RANDOM)).as_matrix()
    T[:3, 3] = position or RANDOM.normal(size=3)
    return T


POSES = [pose() for _ in range(4)]


def numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def g2o(poses: dict[int, Pose], tail: str = "") -> str:
    """As g2o writes it, quaternions by SciPy."""
    lines = ["# a graph", "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", ""]
    for key, T in poses.items():
        lines.append(
            f"VERTEX_SE3:QUAT {key} {numbers(*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())}"
        )
    return "\n".join([*lines, "FIX 0", "VERTEX_TRACKXYZ 99 1 2 3", tail]) + "\n"


def polled(path: Path) -> ChangedPoses:
    found = open_pose_source(path).poll(float("inf"))
    assert found is not None
    return found


def assert_same(found: ChangedPoses, wanted: dict) -> None:
    assert found.keys() == wanted.keys()
    for key, T in wanted.items():
        np.testing.assert_allclose(np.asarray(found[key]), T, atol=1e-12)


def test_a_g2o_graph_gives_poses_by_number_and_its_edges(tmp_path: Path) -> None:
    information = RANDOM.normal(size=(6, 6))
    information = information @ information.T
    T = pose()
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    edge = f"EDGE_SE3:QUAT 0 7 {numbers(*T[:3, 3], *quaternion)} {numbers(*information[np.triu_indices(6)])}"
    path = tmp_path / "graph.g2o"
    path.write_text(g2o({0: POSES[0], 7: POSES[1]}, edge))
    assert_same(polled(path), {0: POSES[0], 7: POSES[1]})
    (found,) = read_pose_graph(path).edges
    assert (found.first, found.second) == (0, 7)
    np.testing.assert_allclose(found.T_first_second, T, atol=1e-12)
    np.testing.assert_allclose(found.information, information)


def test_a_toro_graph_has_roll_pitch_and_yaw(tmp_path: Path) -> None:
    lines = []
    for key, T in enumerate(POSES):
        yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
        lines.append(f"VERTEX3 {key} {numbers(*T[:3, 3], roll, pitch, yaw)}")
    path = tmp_path / "graph.txt"  # recognised by its first word
    path.write_text("\n".join([*lines, "EDGE3 0 1 1 2 3 0 0 0"]))
    assert_same(read_pose_graph(path).poses, dict(enumerate(POSES)))
    (edge,) = read_pose_graph(path).edges
    assert edge.information is None
    np.testing.assert_array_equal(edge.T_first_second, pose(Rotation.identity(), 1, 2, 3))


def test_gtsam_symbols_are_numbers_with_a_letter(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(g2o({(ord("x") << 56) + 3: POSES[0]}))
    assert_same(polled(path), {3: POSES[0]})
    path.write_text(g2o({(ord("x") << 56) + 3: POSES[0], (ord("y") << 56) + 3: POSES[1]}))
    with pytest.raises(DatasetError, match=r"graph.g2o line 5: the number 3 stands for another vertex"):
        read_pose_graph(path)


def test_a_written_graph_is_read_as_it_was(tmp_path: Path) -> None:
    path, root = tmp_path / "graph.g2o", RANDOM.normal(size=(6, 6))
    poses = {3: POSES[0], 0: POSES[1], 12: POSES[2]}
    edges = [PoseEdge(3, 12, POSES[3], root @ root.T), PoseEdge(12, 0, POSES[0])]
    write_pose_graph(path, PoseGraph(poses, edges))
    found = read_pose_graph(path)
    assert_same(found.poses, poses)
    for edge, wanted in zip(found.edges, edges, strict=True):
        assert (edge.first, edge.second) == (wanted.first, wanted.second)
        np.testing.assert_allclose(edge.T_first_second, wanted.T_first_second, atol=1e-12)
    np.testing.assert_array_equal(found.edges[0].information, edges[0].information)
    np.testing.assert_array_equal(found.edges[1].information, np.eye(6))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("VERTEX_SE2 0 1 2 0.5", "line 1: VERTEX_SE2 is a pose in the plane"),
        ("VERTEX3 0 1 2 3 0 0", "line 1: VERTEX3 has 5 numbers after its vertices, needs 6"),
        ("VERTEX3 zero 1 2 3 0 0 0", "line 1: VERTEX3 needs the number of a vertex"),
        ("VERTEX3 0 1 2 3 0 nan 0", "line 1: a pose contains a value that is not finite"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0", "line 1: the quaternion of a pose is zero"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 w", "line 1: contains something that is not a number"),
        ("VERTEX3 0 0 0 0 0 0 0\nEDGE3 0 1 0 0 0 0 0 0 1 2", "line 2: expected 21 finite numbers"),
        ("FIX 0", "contains no VERTEX_SE3:QUAT or VERTEX3"),
    ],
)
def test_a_broken_graph_is_refused_with_file_and_line(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(line)
    with refusal(DatasetError, words) as caught:
        read_pose_graph(path)
    assert str(caught.value).startswith(str(path))


_WORD = st.sampled_from(
    ["VERTEX3", "VERTEX_SE3:QUAT", "EDGE3", "EDGE_SE3:QUAT", "0", "1", "-7", "1e999", "x", "nan"]
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(lines=st.lists(st.lists(_WORD | st.floats().map(repr) | st.text(max_size=3), max_size=10), max_size=4))
def test_any_text_is_poses_or_an_error_that_names_the_file(tmp_path: Path, lines: list[list[str]]) -> None:
    for name in ("graph.g2o", "poses.txt", "poses.json"):
        path = tmp_path / name
        path.write_bytes("\n".join(map(" ".join, lines)).encode("utf-8", "surrogatepass") + b"\n")
        source = open_pose_source(path)
        assert isinstance(source, WatchedFile)
        found, problem = {}, str(path)
        try:
            found = source.read_now()
        except DatasetError as error:
            problem = str(error)
        assert str(path) in problem
        assert all(np.isfinite(np.asarray(T)).all() for T in found.values())


def test_trajectories_give_stamps_or_numbers(tmp_path: Path) -> None:
    path = write_stamped(tmp_path / "poses.txt", np.arange(4) * 0.5, POSES)
    assert_same(polled(path), {0.5 * i: T for i, T in enumerate(POSES)})
    assert all(isinstance(key, float) for key in polled(path))
    for rows in (write_rows(tmp_path / "rows.txt", POSES), write_log(tmp_path / "choi.log", POSES)):
        with rows.open("a") as file:
            file.write("\n")
        assert_same(polled(rows), dict(enumerate(POSES)))


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_file_counts_when_it_is_whole_and_is_a_problem_when_it_stays_broken(tmp_path: Path) -> None:
    path, clock = tmp_path / "poses.txt", Clock()
    other = open_pose_source(path)  # may follow later
    assert isinstance(other, WatchedFile)
    source = WatchedFile(path, other._read, clock=clock)
    assert source.poll(0.0) is None
    lines = [stamped_line(float(i), T) for i, T in enumerate(POSES)]

    def write(text: str) -> None:
        clock.now += 10.0
        path.write_text(text)
        os.utime(path, ns=(0, round(clock.now * 1e9)))

    write(lines[0] + "\n")
    assert_same(source.poll(0.0) or {}, {0.0: POSES[0]})
    assert source.poll(0.0) is None  # nothing new
    write(lines[0] + "\n" + lines[1][:-3])  # cut off inside its last number
    assert source.poll(0.0) is None
    write("\n".join(lines[:3]))  # whole, but its last line has no end
    assert source.poll(0.0) is None
    clock.now += SETTLES_S
    assert_same(source.poll(0.0) or {}, {float(i): POSES[i] for i in range(3)})
    write(lines[0] + "\n1.0 2.0\n")
    assert source.poll(0.0) is None
    assert source.problem is None
    clock.now += STAYS_BROKEN_S + 0.1
    assert source.poll(0.0) is None
    assert source.problem is not None
    assert f"{path} line 2" in source.problem
    write("\n".join(lines) + "\n")
    assert_same(source.poll(0.0) or {}, {float(i): T for i, T in enumerate(POSES)})
    assert source.problem is None


def matched(changed: ChangedPoses, names: list[str]) -> FramePoses:
    poses = FramePoses(CallbackPoses(lambda stamp_s: changed), names)
    assert poses.renew()
    return poses


def test_numbers_are_those_in_names_or_indices_whichever_fits_more() -> None:
    names = [f"frame-{10 * i:06d}" for i in range(4)]
    by_name = matched({0: POSES[0], 20: POSES[1], 55: POSES[2]}, names)
    assert by_name.unknown == ["55"]
    np.testing.assert_array_equal(by_name.of(names[2], 0.0), POSES[1])
    assert by_name.of(names[1], 0.0) is None
    by_index = matched({0: POSES[0], 2: POSES[1], 3: POSES[2], 4: POSES[3]}, names)
    assert by_index.unknown == ["4"]
    np.testing.assert_array_equal(by_index.of(names[2], 0.0), POSES[1])


def test_names_and_stamps_find_their_frames() -> None:
    poses = matched({"a": POSES[0], "z": POSES[3], 1.0: POSES[1], 1.08: POSES[2]}, ["a", "b", "c", "d"])
    assert poses.unknown == ["z"]
    np.testing.assert_array_equal(poses.of("a", 1.0), POSES[0])
    np.testing.assert_array_equal(
        poses.of("b", 1.0004), POSES[1]
    )  # a rounded stamp, before the first pose too
    np.testing.assert_array_equal(poses.of("b", 0.9996), POSES[1])
    between = poses.of("c", 1.04)
    np.testing.assert_allclose(between[:3, 3], (POSES[1][:3, 3] + POSES[2][:3, 3]) / 2)
    assert poses.of("d", 1.2) is None
    assert poses.of("d", float("nan")) is None


def test_frames_take_the_poses_of_a_file_and_what_it_lacks_is_said(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(g2o({1: POSES[1], 3: POSES[3]}))
    posed = posed_by(sequence(4), open_pose_source(path))
    for index in (1, 3):
        np.testing.assert_allclose(posed.read(index).T_world_camera, POSES[index], atol=1e-12)
    assert posed.notes[-1] == "2 of 4 frames have no pose there, and move with the last one before them"
    path.write_text(g2o({1: POSES[1], 17: POSES[2], 18: POSES[2], 19: POSES[2], 20: POSES[2]}))
    (warning,) = (note for note in posed_by(sequence(4), open_pose_source(path)).notes if "lacks" in note)
    assert warning.endswith("has poses of 4 frames that the recording lacks: 17, 18, 19, ...")
    path.write_text(g2o({17: POSES[1]}))
    with pytest.raises(DatasetError, match="has a pose for none of the 4 frames"):
        posed_by(sequence(4), open_pose_source(path))
    path.write_text("VERTEX_SE3:QUAT 0 1")
    with pytest.raises(DatasetError, match=r"graph.g2o line 1"):
        posed_by(sequence(4), open_pose_source(path))
    with pytest.raises(DatasetError, match="no such file"):
        posed_by(sequence(4), open_pose_source(tmp_path / "missing.txt"))


def test_unnamed_frames_are_carried_along(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(g2o({1: POSES[1], 3: POSES[3]}))
    frames = sequence(6, broken=(4,))
    posed = posed_by(frames, open_pose_source(path))
    recorded = [sequence(6).read(index).T_world_camera for index in range(6)]
    for index, carrier in ((0, None), (1, 1), (2, 1), (3, 3), (5, 3)):
        T = recorded[index]
        if carrier is not None:
            T = POSES[carrier] @ np.linalg.inv(recorded[carrier]) @ T
        np.testing.assert_allclose(posed.read(index).T_world_camera, T, atol=1e-12)
    path.write_text(g2o({4: POSES[2]}))  # which cannot be read: nothing says where it was recorded
    posed = posed_by(frames, open_pose_source(path))
    np.testing.assert_array_equal(posed.read(5).T_world_camera, recorded[5])


def test_an_impossible_pose_of_a_callback_is_named() -> None:
    with pytest.raises(DatasetError, match=r"the callback: the pose of frame 1: .* shape"):
        posed_by(sequence(4), CallbackPoses(lambda stamp_s: {"frame 1": np.eye(3)}))


def test_a_recording_without_poses_takes_those_of_a_file(tmp_path: Path) -> None:
    with writing(tmp_path / "walk.bag", "ros1") as bag:
        _fill(bag)
    path = tmp_path / "poses.txt"
    write_stamped(path, [START + 0.1 * i for i in (0, 1, 3)], [POSES[i] for i in (0, 1, 3)])
    with path.open("a") as file:
        file.write(f"{START + 0.2} nan nan nan 0 0 0 1\n")
    dataset = open_posed(tmp_path / "walk.bag", path, max_time_gap=0.01)
    assert any("1 of 4 poses" in note and "left out" in note for note in dataset.notes)
    assert list(dataset.frame_names) == ["000000", "000001", "000003"]
    np.testing.assert_allclose(dataset.read(2).T_world_camera, POSES[3], atol=1e-12)
    assert dataset.dropped == 1
    assert not dataset.tracked
    with pytest.raises(DatasetError, match="--follow needs poses from the start"):
        open_posed(tmp_path / "walk.bag", path, follow=True)
    tracked = open_posed(tmp_path / "walk.bag", None, track=True)
    with pytest.raises(DatasetError, match="cannot replace them"):
        posed_by(tracked, open_pose_source(path))


def _fill(bag: Bag) -> None:
    bag.camera_info("/camera_info", "optical", CAMERA)
    for i in range(4):
        bag.image("/depth", 0.1 * i, "optical", np.full(CAMERA.shape, 1000, np.uint16), "16UC1")


@pytest.mark.parametrize("write", [write_tum, write_numbered])
def test_folders_without_poses_are_tracked_or_take_those_of_a_file(
    tmp_path: Path, write: Callable[[Path, Content], Path]
) -> None:
    content = Content(4)
    folder = write(tmp_path / "mine", content)
    (folder / "groundtruth.txt").unlink(missing_ok=True)
    refused(folder, "--poses FILE takes them", ", --track-poses finds them")
    tracked = open_dataset(folder, track=True)
    assert tracked.tracked
    assert len(tracked) == 4
    stamps = tracked.stamps()
    posed = open_posed(folder, write_stamped(tmp_path / "slam.txt", stamps, content.poses))
    for i, T in enumerate(content.poses):
        np.testing.assert_allclose(posed.pose(i), T, atol=1e-9)


def offset(*metres: float) -> Pose:
    T = np.eye(4)
    T[:3, 3] = metres
    return T


def camera_path(T_fixed_odom: Pose) -> dict[float, Pose]:
    """The camera's poses by their stamps."""
    return {stamp(i): T_fixed_odom @ world_body(i) @ T_body_camera for i in range(COUNT)}


def assert_poses(found: ChangedPoses | None, wanted: dict[float, Pose]) -> None:
    np.testing.assert_allclose(list(found), [START + stamp for stamp in wanted])
    for T, expected in zip(found.values(), wanted.values(), strict=True):
        np.testing.assert_allclose(np.asarray(T), expected, atol=1e-9)


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_path_that_is_sent_again_corrects_earlier_poses(make: Make, kind: Kind) -> None:
    first = {stamp(i): world_body(i) for i in range(2)}
    last = {stamp(i): offset(0.0, 0.3, 0.1 * i) @ world_body(i) for i in range(4)}

    def paths(bag: Bag) -> None:
        bag.path("/slam/path", stamp(0) - 0.5, "map", {})  # nothing known yet
        bag.path("/slam/path", stamp(1), "map", first)
        bag.path("/slam/path", stamp(3), "map", last)

    path = make(plain, paths, kind=kind)
    source = open_pose_source(path)
    assert source.name == f"{path}: /slam/path"
    assert source.poll(float("-inf")) is None
    assert source.poll(START + stamp(0)) is None
    assert_poses(source.poll(START + stamp(1)), {s: T @ T_body_camera for s, T in first.items()})
    assert source.poll(START + stamp(2)) is None
    assert_poses(source.poll(float("inf")), {s: T @ T_body_camera for s, T in last.items()})
    assert source.poll(float("inf")) is None

    # Frames that the last message does not name move with the last one that it does.
    last |= {stamp(i): offset(0.0, 0.3, 0.3) @ world_body(i) for i in range(4, COUNT)}
    followed = open_posed(path, path, follow=True)
    assert isinstance(followed, PosedFrames)
    for now, known in ((stamp(0), {}), (stamp(2), first), (stamp(3), last)):
        followed.poses.renew(START + now)
        for i in range(COUNT):
            T = known.get(stamp(i), world_body(i)) @ T_body_camera
            np.testing.assert_allclose(followed.read(i).T_world_camera, T, atol=1e-9)
    posed = open_posed(path, path)  # the last message, for the recording itself
    for i in range(COUNT):
        T = last.get(stamp(i), world_body(i)) @ T_body_camera
        np.testing.assert_allclose(posed.read(i).T_world_camera, T, atol=1e-9)


def test_a_transform_that_jumps_moves_all_earlier_poses(make: Make) -> None:
    before, jump = offset(0.0, 0.0, 0.5), offset(0.2, -0.1, 0.0)

    def corrected(bag: Bag) -> None:
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), "map", "odom", jump if i >= 3 else before)

    in_earth = partial(mounted, parent="earth", child="map", T=offset(0.0, 0.0, 7.0))
    path = make(images, mounted, moving_tf, corrected, in_earth, kind="sqlite")
    source = open_pose_source(f"{path}?pose=tf&frame=map")
    for now, T_map_odom in ((stamp(1), before), (stamp(4), jump)):
        assert_poses(source.poll(START + now), camera_path(T_map_odom))
    assert source.poll(float("inf")) is None
    earth = open_pose_source(f"{path}?pose=tf").poll(float("inf"))
    assert_poses(earth, camera_path(offset(0.2, -0.1, 7.0)))


def test_a_topic_of_single_poses_does_not_change(make: Make) -> None:
    source = open_pose_source(make(plain))
    assert_poses(source.poll(float("-inf")), camera_path(np.eye(4)))
    assert source.poll(float("inf")) is None


def test_what_a_bag_cannot_tell_is_refused(make: Make) -> None:
    def paths(bag: Bag) -> None:
        bag.path("/a", 1.0, "map", {1.0: world_body(0)})
        bag.path("/b", 1.0, "map", {})

    path = make(images, mounted, partial(moving_tf, numbers=(0, 1)), paths, kind="mcap")
    for query, words in (
        ("", r"choose one with \?pose=/a or \?pose=/b or \?pose=tf"),
        ("?pose=/c", "there is no topic /c"),
        ("?pose=/b", "topic /b: no message contains a pose"),
        ("?pose=tf", f"tf corrects nothing between odom and {FRAME}"),
        ("?pose=/a&body=wheel", "tf has no frame 'wheel'"),
        ("?poses=x.txt", "does not work with --poses"),
        ("?pose=/camera/depth/image_raw", "is of type sensor_msgs/msg/Image"),
    ):
        with pytest.raises(DatasetError, match=words):
            open_pose_source(f"{path}{query}").poll(float("inf"))
