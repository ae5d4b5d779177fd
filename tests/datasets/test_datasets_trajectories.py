"""The text formats of poses: every layout comes back as written, and every defect names its line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal

from taichi_mrf.datasets.trajectories import is_trajectory, read_matrix_file, read_trajectory, valid_poses
from taichi_mrf.errors import DatasetError, KeyframeError


def rotate(q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """A unit quaternion x y z w applied to a vector, by v + 2 w (u x v) + 2 u x (u x v)."""
    u, w = q[:3], q[3]
    return v + 2 * w * np.cross(u, v) + 2 * np.cross(u, np.cross(u, v))


def random_poses(count: int) -> NDArray[np.float64]:
    random = np.random.default_rng(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        Q, _ = np.linalg.qr(random.normal(size=(3, 3)))
        pose[:3, :3] = Q * np.sign(np.linalg.det(Q))
        pose[:3, 3] = random.normal(size=3)
    return poses


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def words(numbers: NDArray[np.float64]) -> str:
    return " ".join(map(repr, np.ravel(numbers).tolist()))


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(0.01, 100))
def test_quaternions_are_normalised_and_rotate_as_such(
    tmp_path_factory: pytest.TempPathFactory, entries: list[float], scale: float
) -> None:
    q = np.array(entries)
    norm = np.linalg.norm(q)
    assume(norm > 1e-3)
    path = tmp_path_factory.mktemp("q") / "groundtruth.txt"
    write(path, "# comment", "", f"12.5 1 2 3 {words(scale * q)}")
    (pose,) = read_trajectory(path).poses
    T = pose.T_world_camera()
    assert pose.key == 12.5
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    for v in np.eye(3):
        np.testing.assert_allclose(T[:3, :3] @ v, rotate(q / norm, v), atol=1e-9)


@pytest.mark.parametrize("rows", [3, 4])
def test_rows_of_matrices(tmp_path: Path, rows: int) -> None:
    poses = random_poses(5)
    path = write(tmp_path / "T.txt", *(words(pose[:rows]) for pose in poses))
    trajectory = read_trajectory(path)
    assert trajectory.layout == "rows"
    assert [pose.key for pose in trajectory.poses] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose([pose.T_world_camera() for pose in trajectory.poses], poses, atol=1e-12)


def test_log_blocks(tmp_path: Path) -> None:
    poses = random_poses(4)
    lines = []
    for i, pose in enumerate(poses):
        lines += [f"{i} {i} {i + 1}", *(words(row) for row in pose)]
    trajectory = read_trajectory(write(tmp_path / "livingroom.log", *lines))
    assert trajectory.layout == "log"
    assert [pose.key for pose in trajectory.poses] == [0, 1, 2, 3]
    np.testing.assert_allclose([pose.T_world_camera() for pose in trajectory.poses], poses, atol=1e-12)
    assert trajectory.poses[2].source.endswith("livingroom.log line 11")


def test_one_matrix_in_a_file_of_its_own(tmp_path: Path) -> None:
    (pose,) = random_poses(1)
    path = write(tmp_path / "frame.pose.txt", *(words(row) for row in pose))
    np.testing.assert_allclose(read_matrix_file(path), pose, atol=1e-12)


GOOD = "0 1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ([GOOD, "1 1 2 3 0 0 1"], "line 2: 7 numbers, expected 8"),
        (["# head", GOOD, "1 1 2 three 0 0 0 1"], "line 3: contains something that is not a number"),
        (["nan 1 2 3 0 0 0 1"], "line 1: the stamp is not finite"),
        (["1 2 3 4 5"], "line 1: 5 numbers"),
        (["# nothing else"], "contains no pose"),
        (["0 0 1", "1 0 0 0", "0 1 0 0"], "line 1: the file ends inside this pose"),
        (["0 0 1", "1 0 0 0", "0 1 0"], "line 3: 3 numbers, expected 4"),
        (
            ["0.5 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"],
            "line 1: a .log block starts with integers",
        ),
        ([" ".join("1" * 12), " ".join("1" * 11)], "line 2: 11 numbers, expected 12"),
    ],
)
def test_a_broken_layout_names_file_and_line(tmp_path: Path, lines: list[str], problem: str) -> None:
    path = write(tmp_path / "poses.txt", *lines)
    with refusal(DatasetError, str(path), problem):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("1 1 2 3 0 0 0 0", "quaternion of a pose is zero"),
        ("1 1 2 nan 0 0 0 1", "not finite"),
        ("1 1 2 3 0 0 nan 1", "not finite"),
        ("1 1 2 3 0 inf 0 1", "not finite"),
    ],
)
def test_a_bad_pose_fails_alone_and_knows_its_line(tmp_path: Path, line: str, problem: str) -> None:
    first, second, third = read_trajectory(write(tmp_path / "poses.txt", GOOD, line, "2 1 2 3 0 0 0 1")).poses
    with pytest.raises(KeyframeError, match=problem):
        second.T_world_camera()
    assert second.source == f"{tmp_path / 'poses.txt'} line 2"
    for good in (first, third):
        np.testing.assert_array_equal(good.T_world_camera()[:3, 3], [1, 2, 3])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("separator", "end"), [(" ", "\n"), (",", "\r\n"), (";", "\n"), ("\t", "\r")])
@pytest.mark.parametrize("head", ["", "# stamp tx ty tz\n", "timestamp,tx,ty,tz,qx,qy,qz,qw\n"])
def test_tables_of_other_programs_are_read(
    tmp_path: Path, encoding: str, separator: str, end: str, head: str
) -> None:
    path = tmp_path / "poses.txt"
    text = head + f"{GOOD}\n2{GOOD[1:]}\n".replace(" ", separator)
    path.write_bytes(text.replace("\n", end).encode(encoding))
    assert is_trajectory(path)
    assert [pose.key for pose in read_trajectory(path).poses] == [0, 2]


def test_poses_of_a_lost_camera_are_left_out_with_a_warning(tmp_path: Path) -> None:
    lost = "1 nan nan nan nan nan nan nan"
    path = write(tmp_path / "poses.txt", GOOD, lost, f"2{GOOD[1:]}", "3 0 0 0 0 0 0 0")
    with pytest.warns(UserWarning, match=r"2 of 4 poses of .* are left out, first .*txt line 2: .*NaN"):
        keys, poses = valid_poses(read_trajectory(path))
    assert (keys, len(poses)) == ([0, 2], 2)
    with pytest.raises(DatasetError, match=r"line 1: .*not finite"):
        valid_poses(read_trajectory(write(path, lost)))


def test_a_file_that_is_no_text_or_not_there(tmp_path: Path) -> None:
    binary = tmp_path / "poses.txt"
    binary.write_bytes(b"\x00\xff\xfe\x81")
    with pytest.raises(DatasetError, match=r"poses\.txt: not a text file"):
        read_trajectory(binary)
    with pytest.raises(DatasetError, match=r"none\.txt: there is no such file"):
        read_trajectory(tmp_path / "none.txt")
    with pytest.raises(DatasetError, match=r"none\.txt: the pose is missing"):
        read_matrix_file(tmp_path / "none.txt")
    with pytest.raises(DatasetError, match="contains 3 numbers"):
        read_matrix_file(write(tmp_path / "short.txt", "1 2 3"))


def test_what_counts_as_a_trajectory(tmp_path: Path) -> None:
    log = ["0 0 1", *["1 0 0 0"] * 4]
    assert is_trajectory(write(tmp_path / "a.txt", "# c", GOOD))
    assert is_trajectory(write(tmp_path / "b.txt", *log))
    assert is_trajectory(write(tmp_path / "c.txt", " ".join("1" * 12)))
    assert not is_trajectory(write(tmp_path / "d.txt", "640 480 525 525 319.5 239.5"))
    assert not is_trajectory(write(tmp_path / "e.txt", "585 0 320", "0 585 240", "0 0 1"))
    assert not is_trajectory(write(tmp_path / "f.txt", "0 depth/0.png 0 rgb/0.png"))
    assert not is_trajectory(write(tmp_path / "g.txt", ""))


STAMP, PLACE, TURN = "12.5", ["1", "2", "3"], ["0", "0.6", "0", "0.8"]
EUROC = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
ROS = (
    "%time,field.header.frame_id,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
    "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w"
)


@pytest.mark.parametrize(
    "lines",
    [
        [EUROC, "12500000000,1,2,3,0.8,0,0.6,0,9,9,9,9,9,9,9,9,9"],
        [ROS, "12.5,world,1,2,3,0,0.6,0,0.8"],
        [ROS.replace("frame_id", "stamp"), "1600000000000000000,12.5,1,2,3,0,0.6,0,0.8"],  # and of arrival
        ["# a walk", "# timestamp qw qx qy qz tx ty tz", "12.5 0.8 0 0.6 0 1 2 3"],
        ["A walk", '"px";"py";"pz";"qx";"qy";"qz";"qw";"Time (s)"', '1;2;"3";"0";"0.6";"0";"0.8";"12.5"'],
        ["#sec,nsec,x,y,z,qx,qy,qz,qw", "12,500000000,1,2,3,0,0.6,0,0.8"],
        ["header.stamp.sec,header.stamp.nanosec,x,y,z,qx,qy,qz,qw", "12,500000000,1,2,3,0,.6,0,.8"],
        ["// no names", "12.5\t1\t2\t3\t0\t0.6\t0\t0.8\t"],
        ["% stamp x y z qx qy qz qw", "12.5, 1, 2, 3, 0, 0.6, 0, 0.8,"],
        ["stamp_ms,pos_x,pos_y,pos_z,rot_w,rot_x,rot_y,rot_z", "12500,1,2,3,.8,0,.6,0"],
    ],
)  # fmt: skip
def test_columns_are_found_by_their_names(tmp_path: Path, lines: list[str]) -> None:
    path = write(tmp_path / "poses.csv", *lines)
    assert is_trajectory(path)
    (pose,) = read_trajectory(path).poses
    assert pose.key == pytest.approx(12.5)
    np.testing.assert_array_equal(pose.values, [1, 2, 3, 0, 0.6, 0, 0.8])


@pytest.mark.parametrize(("stamp", "key"), [("1600000000500000000", 1.6e9 + 0.5), ("12.5", 12.5)])
def test_a_stamp_before_a_matrix_is_no_number_of_a_frame(tmp_path: Path, stamp: str, key: float) -> None:
    path = write(tmp_path / "poses.csv", f"{stamp},1,0,0,1,0,1,0,2,0,0,1,3")
    trajectory = read_trajectory(path)
    assert trajectory.layout == "stamped"
    (pose,) = trajectory.poses
    assert pose.key == pytest.approx(key, abs=1e-6)
    np.testing.assert_array_equal(pose.T_world_camera()[:3, 3], [1, 2, 3])


def test_the_list_of_colmap_is_refused(tmp_path: Path) -> None:
    head = "# Image list\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    path = write(tmp_path / "images.txt", head, "1 1 0 0 0 1 2 3 1 a.jpg", "")
    with pytest.raises(
        DatasetError, match="COLMAP's list of images: its poses are T_camera_world, and in no"
    ):
        read_trajectory(path)


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
def test_stamps_since_1970_are_seconds(tmp_path: Path, unit: int) -> None:
    path = write(tmp_path / "poses.txt", f"{1_600_000_000 * unit + unit // 8} 1 2 3 0 0.6 0 0.8")
    assert read_trajectory(path).poses[0].key == 1_600_000_000 + (0.125 if unit > 1 else 0)


def test_seven_columns_are_poses_in_their_order(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.txt", "tx ty tz qw qx qy qz", "1 2 3 0.8 0 0.6 0", "4 5 6 1 0 0 0")
    trajectory = read_trajectory(path)
    assert is_trajectory(path)
    assert (trajectory.layout, [pose.key for pose in trajectory.poses]) == ("rows", [0, 1])
    np.testing.assert_array_equal(trajectory.poses[0].values, [1, 2, 3, 0, 0.6, 0, 0.8])
    np.testing.assert_array_equal(trajectory.poses[1].T_world_camera()[:3, 3], [4, 5, 6])
    assert not is_trajectory(write(tmp_path / "boxes.txt", "1 2 3 10 20 30 40"))


def test_a_line_shorter_than_its_header_and_a_stamp_that_comes_twice_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"line 2: 3 numbers, expected 17 as the header names"):
        read_trajectory(write(tmp_path / "a.csv", EUROC, "1,2,3"))
    with pytest.raises(DatasetError, match=r"line 2: 9 numbers, expected 8 as the header names"):
        read_trajectory(write(tmp_path / "c.csv", "# t x y z qx qy qz qw", "1 2 3 4 5 0 0 0 1"))
    with pytest.warns(
        UserWarning, match=r"1 of 3 poses .* have the stamp of one before, first .* line 3: 1\.0"
    ):
        read_trajectory(write(tmp_path / "b.txt", "1 0 0 0 0 0 0 1", "2 0 0 0 0 0 0 1", "1 9 0 0 0 0 0 1"))


def test_of_a_clock_that_starts_again_the_longest_run_is_read(tmp_path: Path) -> None:
    """Lines that are only out of order are no runs."""
    lines = [f"{stamp} {i} 0 0 0 0 0 1" for i, stamp in enumerate([*range(5, 12), *range(20)])]
    path = write(tmp_path / "two.txt", "# two runs", *lines)
    with pytest.warns(UserWarning, match=r"two\.txt: .*runs from line 2 \(7 poses\), line 9 \(20 poses\)"):
        keys, poses = valid_poses(read_trajectory(path))
    assert keys == list(range(20))
    assert [T[0, 3] for T in poses] == list(range(7, 27))
    shuffled = np.random.default_rng(0).permutation(lines[7:]).tolist()
    assert len(read_trajectory(write(tmp_path / "shuffled.txt", *shuffled)).poses) == 20
