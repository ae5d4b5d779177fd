"""Motion capture on simulated streams: the time lag, where markers sit, and the board's pose from both."""

from pathlib import Path

import numpy as np
import pytest
from calibration_boards import BOARD, CAMERA, board_motion, captured, ideal_view
from datasets_recordings import write_stamped
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.calibration.motion_capture import Alignment, BodyPair, align, estimate_lag, hand_eye
from taichi_mrf.calibration.options import BoardConfig, MotionCaptureConfig
from taichi_mrf.calibration.truth_sources import stamps_of
from taichi_mrf.datasets.timed_poses import TimedPoses, read_timed_poses
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import inverses, rotation_vectors, rotations

OPTIONS = MotionCaptureConfig()
SECONDS = 6.0
STAMPS = np.arange(0, SECONDS, 1 / 18.7)
INTERVAL = STAMPS[1] - STAMPS[0]


def aligned(lag: float, noise_px: float, noise_m: float, seed: int) -> tuple[Alignment, BodyPair]:
    random = np.random.default_rng(seed)
    capture = captured(lag, SECONDS, random, noise_m)
    bodies = BodyPair(capture.camera, capture.board)
    views = [ideal_view(T, random, noise_px) for T in board_motion(STAMPS)]
    return align(STAMPS, views, bodies, BOARD, CAMERA, OPTIONS), bodies


@pytest.mark.parametrize("lag", [-0.613, 0.0, 0.087, 0.9])
def test_the_lag_is_found_from_speeds_to_less_than_an_interval(lag: float) -> None:
    capture = captured(lag, SECONDS, np.random.default_rng(0))
    found = estimate_lag(STAMPS, board_motion(STAMPS), BodyPair(capture.camera, capture.board), OPTIONS)
    assert found.seconds == pytest.approx(lag, abs=0.3 * INTERVAL)
    assert found.correlation > 0.9


def test_alignment_finds_lag_and_markers_within_its_standard_error() -> None:
    z, poses = [], []
    for seed, lag in enumerate((-0.4, 0.0871) * 3):
        alignment, _ = aligned(lag, noise_px=0.1, noise_m=1e-4, seed=seed)
        assert alignment.lag_error < 5e-4
        assert alignment.lag == pytest.approx(lag, abs=2e-3)
        z.append((alignment.lag - lag) / alignment.lag_error)
        poses.append(alignment.T_camera_body)
    assert np.sqrt(np.mean(np.square(z))) < 2.0
    assert np.abs(np.mean(z)) * np.sqrt(len(z)) < 4
    truth = captured(0.0, SECONDS, np.random.default_rng(0)).T_camera_body
    assert np.abs(np.mean(poses, axis=0)[:3, 3] - truth[:3, 3]).max() < 1e-3


def test_without_noise_the_board_is_where_it_is() -> None:
    alignment, bodies = aligned(0.2, noise_px=0.0, noise_m=0.0, seed=0)
    between = STAMPS[:-1] + 0.3 * INTERVAL
    T, known = alignment.T_camera_board(between, bodies, OPTIONS.largest_gap)
    assert known.all()
    # Interpolation at 120 Hz is all that is left.
    assert alignment.reprojection < 0.02
    assert np.abs(T - board_motion(between)).max() < 2e-4
    assert alignment.lag == pytest.approx(0.2, abs=1e-4)


def test_a_camera_on_a_tripod_needs_one_pose() -> None:
    times = np.arange(-1, SECONDS + 1, 1 / 120)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3], T_world_camera[:3, 3] = rotations(np.array([[1.0, 0.2, -0.5]]))[0], [3, 2, 1]
    bodies = BodyPair(
        TimedPoses(np.array([0.0]), T_world_camera[None]),
        TimedPoses(times + 0.05, T_world_camera @ board_motion(times)),
    )
    random = np.random.default_rng(1)
    views = [ideal_view(T, random, 0.05) for T in board_motion(STAMPS)]
    alignment = align(STAMPS, views, bodies, BOARD, CAMERA, OPTIONS)
    assert alignment.lag == pytest.approx(0.05, abs=1e-3)
    np.testing.assert_allclose(alignment.T_camera_body @ alignment.T_body_board, np.eye(4), atol=2e-3)


def test_hand_eye_is_exact_without_noise() -> None:
    capture = captured(0.0, SECONDS, np.random.default_rng(0))
    M = inverses(capture.camera.poses) @ capture.board.poses
    T_camera_board = capture.T_camera_body @ M @ capture.T_body_board
    T_camera_body, T_body_board = hand_eye(T_camera_board, M)
    np.testing.assert_allclose(T_camera_body, capture.T_camera_body, atol=1e-9)
    np.testing.assert_allclose(T_body_board, capture.T_body_board, atol=1e-9)
    with pytest.raises(DatasetError, match="tilt the board about two axes"):
        hand_eye(np.repeat(T_camera_board[:1], 5, axis=0), np.repeat(M[:1], 5, axis=0))


def test_streams_that_do_not_belong_together_are_refused() -> None:
    capture = captured(0.0, SECONDS, np.random.default_rng(0))
    poses = board_motion(STAMPS)
    faster = TimedPoses(capture.board.stamps, capture.board.poses[::-1])
    with pytest.raises(DatasetError, match="motion in the images does not match motion capture"):
        estimate_lag(STAMPS, poses, BodyPair(capture.camera, faster), OPTIONS)
    later = TimedPoses(capture.board.stamps + 100, capture.board.poses)
    with pytest.raises(DatasetError, match="overlap too little"):
        estimate_lag(STAMPS, poses, BodyPair(capture.camera, later), OPTIONS)
    with pytest.raises(DatasetError, match="needs 10 views of the board"):
        estimate_lag(STAMPS[:5], poses[:5], BodyPair(capture.camera, capture.board), OPTIONS)


def test_a_board_that_looks_the_same_upside_down_is_refused() -> None:
    capture = captured(0.0, 1.0, np.random.default_rng(0))
    board = BoardConfig(columns=7, rows=5, square=0.08)
    with pytest.raises(ConfigError, match="must not look the same upside down"):
        align(STAMPS, [], BodyPair(capture.camera, capture.board), board, CAMERA, OPTIONS)


def test_slipped_markers_are_noticed() -> None:
    capture = captured(0.0, SECONDS, np.random.default_rng(0))
    slipped = capture.board.poses.copy()
    slipped[len(slipped) // 2 :, :3, 3] += slipped[len(slipped) // 2 :, :3, 0] * 0.3
    bodies = BodyPair(capture.camera, TimedPoses(capture.board.stamps, slipped))
    views = [ideal_view(T, np.random.default_rng(0), 0.05) for T in board_motion(STAMPS)]
    with pytest.raises(DatasetError, match=r"pixels \(RMS\) from where the images show them"):
        align(STAMPS, views, bodies, BOARD, CAMERA, OPTIONS)


@given(
    first=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    turn=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    share=st.floats(0, 1),
)
def test_poses_are_interpolated_along_the_shortest_way(
    first: tuple[float, ...], turn: tuple[float, ...], share: float
) -> None:
    T = np.repeat(np.eye(4)[None], 2, axis=0)
    T[:, :3, :3] = rotations(np.array([first]))[0] @ rotations(np.array([[0.0] * 3, turn]))
    T[:, :3, 3] = [[0, 1, 2], [2, 1, 0]]
    between, known = TimedPoses(np.array([5.0, 7.0]), T).between(np.array([5 + 2 * share]), 2.0)
    assert known[0]
    np.testing.assert_allclose(between[0, :3, 3], [2 * share, 1, 2 - 2 * share], atol=1e-9)
    np.testing.assert_allclose(
        rotation_vectors(T[0, :3, :3].T @ between[0, :3, :3]), share * np.array(turn), atol=1e-7
    )


def test_nothing_is_interpolated_over_gaps_or_beyond_the_ends() -> None:
    stream = TimedPoses(np.array([0.0, 0.01, 1.0]), np.repeat(np.eye(4)[None], 3, axis=0))
    _, known = stream.between(np.array([-0.1, 0.005, 0.5, 1.1]), 0.05)
    assert known.tolist() == [False, True, False, False]


def test_streams_are_read_back_whatever_their_order_and_separator(tmp_path: Path) -> None:
    stream = captured(0.0, 0.2, np.random.default_rng(0)).board
    write_stamped(tmp_path / "board.csv", stream.stamps, stream.poses)
    lines = (tmp_path / "board.csv").read_text().splitlines()
    (tmp_path / "board.csv").write_text("\n".join(line.replace(" ", ",") for line in reversed(lines)))
    read = read_timed_poses(tmp_path / "board.csv")
    np.testing.assert_allclose(read.stamps, stream.stamps, atol=1e-8)
    np.testing.assert_allclose(read.poses, stream.poses, atol=1e-7)
    (tmp_path / "rows.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(DatasetError, match=r"rows\.txt: poses without stamps"):
        read_timed_poses(tmp_path / "rows.txt")
    (tmp_path / "zero.txt").write_text("1 0 0 0 0 0 0 0\n")
    with pytest.raises(DatasetError, match=r"zero\.txt line 1: the quaternion of a pose is zero"):
        read_timed_poses(tmp_path / "zero.txt")


def test_stamps_come_from_a_file_or_from_the_names(tmp_path: Path) -> None:
    file = tmp_path / "stamps.txt"
    file.write_text("# comment\n1.5 depth/0000.png\n2.5, 0001\n3.5 1305031102.160407\n")
    assert stamps_of(["0000", "0001"], file) == {"0000": 1.5, "0001": 2.5}
    assert stamps_of(["1305031102.160407"], file) == {"1305031102.160407": 3.5}
    assert stamps_of(["1305031102.160407"], None) == {"1305031102.160407": 1305031102.160407}
    with pytest.raises(DatasetError, match=r"stamps\.txt: has no stamp for 0002"):
        stamps_of(["0002"], file)
    with pytest.raises(DatasetError, match="image frame-1: its name is not a stamp"):
        stamps_of(["frame-1"], None)
    file.write_text("one 0000.png\n")
    with pytest.raises(DatasetError, match=r"stamps\.txt line 1: expected a stamp"):
        stamps_of(["0000"], file)
