"""Keyframes that follow poses which change: where they end, what a run waits for, and what it warns of."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sliding_camera import ALL_FRAMES, StopAfter, names, sequence
from small_room import assert_same_voxels

from taichi_mrf.config.schema import Config, PoseConfig
from taichi_mrf.datasets.pose_sources.base import CallbackPoses, ChangedPoses, WatchedFile, open_pose_source
from taichi_mrf.datasets.pose_sources.posed import posed_by
from taichi_mrf.errors import CapacityError, ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.mapping import follow, pipeline
from taichi_mrf.mapping.follow import PoseFollower
from taichi_mrf.mapping.pipeline import Event, WaitingForPoses, map_sequence
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map

pytestmark = [
    pytest.mark.usefixtures("one_backend"),
    pytest.mark.filterwarnings("ignore:.* stay where they were recorded"),
]


@pytest.fixture(autouse=True)
def _final_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    final_after(monkeypatch, 0.0)


def final_after(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    for module in (follow, pipeline):
        monkeypatch.setattr(module, "FINAL_AFTER_S", seconds)


def shifted(index: int, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Pose:
    T = sequence().read(index).T_world_camera.copy()
    T[:3, 3] += (x_m, y_m, z_m)
    return T


class Versions:
    """Gives one version of the poses after the other, the next with each call, and then nothing new."""

    def __init__(self, versions: Sequence[ChangedPoses | None]) -> None:
        self.versions, self.stamps = list(versions), []

    def __call__(self, stamp_s: float) -> ChangedPoses | None:
        self.stamps.append(stamp_s)
        return self.versions.pop(0) if self.versions else None


def followed(
    versions: Sequence[ChangedPoses | None], config: Config = ALL_FRAMES, **options: object
) -> OccupancyMap:
    dataset = posed_by(sequence(), CallbackPoses(Versions(versions)), follow=True)
    return map_sequence(dataset, config, **options).map  # type: ignore[arg-type]


def anew(poses: dict[int, Pose], config: Config = ALL_FRAMES) -> OccupancyMap:
    """The map of the frames at these poses, by index, and of the others where the last of these before them
    carries them."""
    m = create_map(config, sequence().camera)
    carry: Pose = np.eye(4)
    for index in range(len(sequence())):
        frame = sequence().read(index)
        T = poses.get(index)
        if T is not None:
            carry = T @ inverse(frame.T_world_camera)
        else:
            T = carry @ frame.T_world_camera
        m.add_keyframe(frame.depth_m, T, frame.camera, frame.name)
    m.infer()
    return m


offsets = st.tuples(*[st.floats(-0.3, 0.3)] * 3)
some_poses = st.dictionaries(st.integers(0, 5), offsets, max_size=4)


@settings(max_examples=6)
@given(versions=st.lists(st.none() | some_poses, max_size=5))
def test_the_map_is_that_made_anew_with_the_last_poses(versions: list[dict | None]) -> None:
    told, last = [], {}
    for version in versions:
        if version is None:
            told.append(None)
            continue
        last |= {index: shifted(index, *offset) for index, offset in version.items()}
        told.append({f"frame {index}": T for index, T in last.items()})
    assert_same_voxels(followed([*told, {f"frame {i}": T for i, T in last.items()}]), anew(last))


def test_keyframes_that_are_not_named_are_carried() -> None:
    source = CallbackPoses(
        Versions([None, None, None, {1: shifted(1, 0.0, 0.1, 0.0)}, {1: shifted(1, 0.0, 0.2)}])
    )
    m = map_sequence(posed_by(sequence(), source, follow=True), ALL_FRAMES).map
    places = [keyframe.T_world_camera for keyframe in m.keyframes.values()]
    for index, T in enumerate(places):
        np.testing.assert_allclose(T, shifted(index, 0.0, 0.2) if index else shifted(0), atol=1e-12)
    assert_same_voxels(m, anew(dict(enumerate(places))))


@pytest.mark.parametrize("method", ["log_odds", "visibility"])
def test_every_method_follows(method: str) -> None:
    config = replace(ALL_FRAMES, method=method)
    last = {2: shifted(2, 0.2, 0.0, 0.1), 4: shifted(4, 0.0, 0.1, 0.0)}
    versions = [{2: shifted(2, 0.1, 0.0, 0.0)}, None, last]
    assert_same_voxels(followed(versions, config), anew(last, config))


def test_keyframes_move_between_frames_and_new_frames_come_at_the_new_poses() -> None:
    source = Versions([None, None, {0: shifted(0, 0.2, 0.0, 0.0), 3: shifted(3, 0.0, 0.3, 0.0)}])
    seen: dict[int, list[np.ndarray]] = {}

    def keep(result: object) -> None:
        for id, keyframe in result.map.keyframes.items():  # type: ignore[attr-defined]
            seen.setdefault(id, []).append(keyframe.T_world_camera[:3, 3])

    dataset = posed_by(sequence(), CallbackPoses(source), follow=True)
    result = map_sequence(dataset, ALL_FRAMES, keep=keep)
    assert [place[0] for place in seen[0][:3]] == pytest.approx([0.0, 0.0, 0.2])
    np.testing.assert_allclose(seen[3][0], (0.3, 0.3, 0.0))  # read after the change
    assert source.stamps[0] == -math.inf
    assert source.stamps[1:7] == pytest.approx([0.1 * index for index in range(6)])
    assert source.stamps[-1] == math.inf
    assert result.followed is not None
    assert (result.followed.changes, result.followed.moves) == (1, 2)  # frame 1 is carried along
    assert "following" in result.seconds


def test_a_run_waits_for_a_file_that_still_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "graph.g2o"
    final_after(monkeypatch, 0.3)
    last, told = {1: shifted(1, 0.1, 0.2, 0.0)}, []

    def listen(event: Event) -> None:
        if isinstance(event, WaitingForPoses):
            told.append(event.quiet_s)
            if len(told) == 1:
                x, y, z = last[1][:3, 3]
                path.write_text(f"VERTEX_SE3:QUAT 1 {x} {y} {z} 0 0 0 1\n")

    dataset = posed_by(sequence(), open_pose_source(path), follow=True)  # which is not there yet
    m = map_sequence(dataset, ALL_FRAMES, listen).map
    assert_same_voxels(m, anew(last))
    assert max(told) <= 0.3


def test_poses_are_final_once_they_are_unchanged_for_long_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    final_after(monkeypatch, 10.0)
    now, source = [0.0], Versions([None, None, {0: shifted(0)}])
    dataset = posed_by(sequence(), CallbackPoses(source), follow=True)
    follower = PoseFollower(MRFMap(0.1), dataset, PoseConfig(), lambda: now[0])
    final = []
    for now[0] in (9.0, 11.0, 20.0, 21.0):
        follower.look()
        final.append(follower.is_final)
    assert final == [False, False, False, True]


def test_a_stop_ends_the_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    final_after(monkeypatch, 1e6)
    stop = StopAfter(WaitingForPoses, 1)
    dataset = posed_by(sequence(), CallbackPoses(Versions([])), follow=True)
    result = map_sequence(dataset, ALL_FRAMES, stop.listen, should_stop=stop)
    assert result.interrupted
    assert result.sweeps == 1
    assert names(result.map) == [f"frame {index}" for index in range(6)]  # type: ignore[arg-type]


def test_poses_of_unknown_frames_and_a_file_that_stays_broken_are_told_once(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="the callback") as warned:
        followed([{1: shifted(1), 8: shifted(1), 9: shifted(1)}])
    assert [str(each.message) for each in warned] == [
        "the callback has poses of 2 frames that the recording lacks: 8, 9",
        "1 of 6 keyframes have no pose in the callback, and stay where they were recorded",
    ]
    now = [0.0]
    path = tmp_path / "poses.txt"
    path.write_text("0 1 2\n")

    def broken(path: Path) -> ChangedPoses:
        raise DatasetError(f"{path} line 1: 3 numbers")

    dataset = posed_by(sequence(), WatchedFile(path, broken, clock=lambda: now[0]), follow=True)
    follower = PoseFollower(MRFMap(0.1), dataset, PoseConfig())
    assert not follower.look()
    assert follower.news() == []
    now[0] = 60.0
    assert not follower.look()
    assert follower.news() == [f"{path} line 1: 3 numbers; the poses read before it stay"]
    assert follower.news() == []


def test_a_pose_for_which_there_is_no_memory_ends_the_run_with_the_map_so_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object, **__: object) -> None:
        raise CapacityError("4 GB are needed")

    monkeypatch.setattr(MRFMap, "update_poses", full)
    dataset = posed_by(sequence(), CallbackPoses(Versions([None, {0: shifted(0, 0.2)}])), follow=True)
    result = map_sequence(dataset, ALL_FRAMES)
    assert result.full == "moving keyframes to their new poses does not fit: 4 GB are needed"
    assert names(result.map) == ["frame 0"]  # type: ignore[arg-type]
    assert result.sweeps > 0


def test_refinement_and_following_exclude_each_other() -> None:
    config = replace(ALL_FRAMES, poses=PoseConfig(refine=True))
    with pytest.raises(ConfigError, match="choose one"):
        followed([], config)
