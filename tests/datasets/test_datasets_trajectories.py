"""The text formats of poses: every layout comes back as written, and every defect names its line. Poses in
between two poses, against SciPy; trees of frames; and stamps in pairs."""

from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import write_stamped
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal
from scipy.spatial.transform import Rotation

from taichi_mrf.datasets.formats.tum_rgbd import associate
from taichi_mrf.datasets.ros.tf import TransformTree
from taichi_mrf.datasets.timed_poses import TimedPoses, interpolate, quaternion, read_timed_poses
from taichi_mrf.datasets.trajectories import is_trajectory, read_matrix_file, read_trajectory, valid_poses
from taichi_mrf.errors import DatasetError, KeyframeError
from taichi_mrf.geometry.poses import Pose, inverse, look_at


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


def slerp(first: Pose, last: Pose, share: float) -> NDArray[np.float64]:
    """Spherical interpolation of rotations by SciPy."""
    begin, end = (Rotation.from_matrix(T[:3, :3]) for T in (first, last))
    return (begin * Rotation.from_rotvec(share * (begin.inv() * end).as_rotvec())).as_matrix()


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


numbers = st.floats(-3, 3)
vectors = st.tuples(numbers, numbers, numbers)
shares = st.floats(0, 1)


def pose(vector: tuple[float, float, float], position: tuple[float, float, float]) -> Pose:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    T[:3, 3] = position
    return T


@given(vectors, vectors, vectors, vectors, shares)
def test_a_pose_in_between_is_scipys(a: tuple, b: tuple, p: tuple, q: tuple, share: float) -> None:
    first, last = pose(a, p), pose(b, q)
    between = interpolate(first, last, share)
    turn = (Rotation.from_matrix(first[:3, :3]).inv() * Rotation.from_matrix(last[:3, :3])).magnitude()
    np.testing.assert_allclose(between[:3, 3], (1 - share) * np.array(p) + share * np.array(q), atol=1e-12)
    if turn < np.pi - 1e-6:  # beyond, both ways round are as short
        np.testing.assert_allclose(between[:3, :3], slerp(first, last, share), atol=1e-8)
    np.testing.assert_allclose(between[:3, :3] @ between[:3, :3].T, np.eye(3), atol=1e-9)


@given(vectors)
def test_a_quaternion_is_that_of_its_rotation(vector: tuple) -> None:
    R = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(quaternion(R)).as_matrix(), R, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn_has_a_quaternion(axis: int) -> None:
    R = -np.eye(3)
    R[axis, axis] = 1
    np.testing.assert_allclose(np.abs(quaternion(R)), np.eye(4)[axis], atol=1e-12)


STAMPS = [1.0, 1.1, 1.4, 1.5]


def test_many_poses_are_interpolated_as_one_by_one() -> None:
    random = np.random.default_rng(0)
    T = np.stack([look_at(eye, target) for eye, target in random.normal(size=(40, 2, 3))])
    share = np.concatenate([[0.0, 1.0], random.random(37)])
    single = [interpolate(a, b, float(s)) for a, b, s in zip(T, T[1:], share, strict=False)]
    np.testing.assert_array_equal(interpolate(T[:-1], T[1:], share), single)


def ramp() -> TimedPoses:
    return TimedPoses(STAMPS, [look_at([stamp, 0, 0], [9, stamp, 0]) for stamp in STAMPS])


@pytest.mark.parametrize(
    ("stamp", "gap", "x"),
    [
        (1.0, 0.0, 1.0),  # a pose of that very stamp needs no neighbour
        (1.5, 0.0, 1.5),
        (1.05, 0.06, 1.05),
        (1.02, 0.06, 1.02),  # one neighbour is further, but the two are near each other
        (1.02, 0.049, None),  # they are too far apart for a time midway, and so for all
        (1.05, 0.05, 1.05),  # just near enough, whatever the rounding
        (1.25, 0.14, None),
        (1.25, 0.15, 1.25),
        (0.999, 9.0, None),  # nothing is made up outside
        (1.501, 9.0, None),
    ],
)
def test_neighbours_must_be_near(stamp: float, gap: float, x: float | None) -> None:
    T = ramp().at(stamp, gap)
    assert (None if T is None else pytest.approx(T[0, 3])) == x


@given(st.permutations(range(4)), st.floats(1.0, 1.5))
def test_the_order_of_recording_does_not_matter(order: list[int], stamp: float) -> None:
    poses = ramp()
    shuffled = TimedPoses([STAMPS[i] for i in order], poses.poses[list(order)])
    np.testing.assert_array_equal(shuffled.at(stamp, 1.0), poses.at(stamp, 1.0))


def test_of_two_poses_with_one_stamp_the_last_counts() -> None:
    poses = TimedPoses([1.0, 2.0, 1.0], [np.eye(4), np.eye(4), look_at([5, 0, 0], [6, 0, 0])])
    assert len(poses) == 2
    assert poses.at(1.0, 0.0)[0, 3] == 5


def test_a_file_of_stamped_poses(tmp_path: Path) -> None:
    path = write_stamped(tmp_path / "poses.txt", STAMPS, ramp().poses)
    found = read_timed_poses(path)
    np.testing.assert_allclose(found.poses, ramp().poses, atol=1e-9)
    np.testing.assert_array_equal(found.stamps, STAMPS)
    path.write_text("1 0 0 0 0 0 0 0")
    with pytest.raises(DatasetError, match=r"poses\.txt line 1"):
        read_timed_poses(path)
    path.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0")
    with pytest.raises(DatasetError, match=r"poses\.txt"):
        read_timed_poses(path)


A, B, C, D = (look_at([i, 1, 2], [3, i, 1]) for i in range(4))


@pytest.fixture
def tree() -> TransformTree:
    """map -> odom -> base -> camera, and map -> beacon -> light."""
    moving = TimedPoses([0.0, 1.0], [B, look_at([2, 1, 2], [3, 2, 1])])
    edges = {"odom": ("map", A), "base": ("odom", moving), "camera": ("base", C), "beacon": ("map", D)}
    return TransformTree({**edges, "light": ("beacon", A)})


def test_a_chain_is_a_product(tree: TransformTree) -> None:
    np.testing.assert_allclose(tree.lookup("map", "camera", 0.0, 0.1), A @ B @ C, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("camera", "map", 0.0, 0.1), inverse(A @ B @ C), atol=1e-12)
    np.testing.assert_allclose(
        tree.lookup("light", "camera", 0.0, 0.1), inverse(D @ A) @ A @ B @ C, atol=1e-12
    )
    np.testing.assert_array_equal(tree.lookup("base", "base", 0.0, 0.1), np.eye(4))
    middle = interpolate(B, look_at([2, 1, 2], [3, 2, 1]), 0.5)
    np.testing.assert_allclose(tree.lookup("map", "camera", 0.5, 0.6), A @ middle @ C, atol=1e-12)


def test_only_what_lies_on_the_way_is_asked_for(tree: TransformTree) -> None:
    assert tree.lookup("map", "camera", 0.5, 0.1) is None
    np.testing.assert_allclose(tree.lookup("map", "light", 0.5, 0.1), D @ A, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("base", "camera", 7.0, 0.1), C, atol=1e-12)
    assert tree.moves("map", "camera")
    assert not tree.moves("map", "light")
    assert not tree.moves("base", "camera")


def test_the_body_is_what_the_camera_is_fixed_to(tree: TransformTree) -> None:
    assert tree.body("camera") == "base"
    assert tree.body("base") == "base"
    assert tree.body("light") == "beacon", "a map is no body"
    assert tree.body("unheard of") == "unheard of"


def test_frames_in_a_circle_are_named() -> None:
    with pytest.raises(DatasetError, match="the frames a, b form a circle"):
        TransformTree({"a": ("b", A), "b": ("a", B)}).ancestors("a")


# No subnormal numbers: Taichi's kernels make the processor take them for zero.
stamps = st.lists(st.floats(0, 2, allow_subnormal=False), max_size=30)


def greedy_oracle(a: list[float], b: list[float], gap: float) -> list[int | None]:
    """All pairs by their difference, each taken if both are free."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= gap)
    out: list[int | None] = [None] * len(a)
    for _, i, j in pairs:
        if out[i] is None and j not in out:
            out[i] = j
    return out


@given(stamps, stamps, st.floats(0, 0.5, allow_subnormal=False))
def test_equals_trying_all_pairs(a: list[float], b: list[float], gap: float) -> None:
    assert associate(a, b, gap) == greedy_oracle(a, b, gap)


def test_stamps_since_1970_keep_their_milliseconds() -> None:
    start = 1305031102.0
    depth = [start + 0.160407, start + 0.194330, start + 0.226738]
    poses = start + np.arange(0, 0.4, 0.01)
    partners = associate(depth, poses.tolist(), 0.02)
    assert partners == [16, 19, 23]
