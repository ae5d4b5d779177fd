"""Poses in between two poses, against SciPy; and trees of frames, against products written out."""

from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import stamped_line
from hypothesis import given
from hypothesis import strategies as st
from inputs_frames import slerp
from scipy.spatial.transform import Rotation

from taichi_mrf.datasets.ros.tf import TransformTree
from taichi_mrf.datasets.timed_poses import TimedPoses, interpolate, quaternion, read_timed_poses
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse, look_at

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
        np.testing.assert_allclose(between[:3, :3], slerp(first[:3, :3], last[:3, :3], share), atol=1e-8)
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
        (1.02, 0.06, None),  # the neighbour on the other side is too far
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
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(stamped_line(s, T) for s, T in zip(STAMPS, ramp().poses, strict=True)))
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
