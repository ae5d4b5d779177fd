"""Live runs whose poses are refined, or found: what becomes of the keyframes, the map, and the page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tracked_room
from inputs_frames import Frames, of_frames
from live_scene import (
    FakeLink,
    asking,
    assert_shown_is,
    finished,
    last_status,
    marginals,
    never,
    session_of,
    shown,
    source,
)
from tracked_room import coarse_frames, disturbed, errors, nowhere, walk

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.cli.options.live import Live
from taichi_mrf.cli.options.map import Map
from taichi_mrf.cli.options.shared import PoseFlags
from taichi_mrf.config.schema import Config, EvaluationConfig, PoseConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.timed_poses import read_timed_poses
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.mapping import rounds
from taichi_mrf.mapping.loops import Closure, LoopCloser
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.session.files import TRAJECTORY_FILE
from taichi_mrf.session.folder import write_run
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.viewer.messages import (
    CurrentCamera,
    KeyframeInfo,
    Move,
    Notice,
    PixelRay,
    RayAnswer,
    Reset,
    Status,
    Switch,
)

pytestmark = pytest.mark.usefixtures("one_backend")

COUNT = 6
REFINE = Config(voxel_size=0.1, poses=PoseConfig(refine=True), evaluation=EvaluationConfig(hold_out=0))


def wrong() -> Frames:
    pairs = zip(coarse_frames()[:COUNT], disturbed(COUNT, 3), strict=True)
    return of_frames([replace(frame, T_world_camera=T) for frame, T in pairs])


def off(poses: list[Pose]) -> np.ndarray:
    """Mean radians and metres off the truth."""
    return np.mean(
        [tangent_norms(f.T_world_camera, T) for f, T in zip(coarse_frames()[:COUNT], poses, strict=True)],
        axis=0,
    )


def told_poses(link: FakeLink) -> dict[int, Pose]:
    return {id: keyframe.T_world_camera for id, keyframe in shown(link.sent).keyframes.items()}


def assert_is_the_map_of_its_poses(session: Session, link: FakeLink, ids: list[int]) -> None:
    """The map is that of the frames at the poses that the page was told of, bit for bit."""
    again = MRFMap.from_config(session.state.source.config, coarse_frames()[0].camera)
    for id in ids:
        frame = coarse_frames()[id % COUNT]
        again.add_keyframe(frame.depth_m, told_poses(link)[id], frame.camera)
    again.infer()
    assert marginals(session.state.mapper.map) == marginals(again)
    assert_shown_is(session, link)


def test_keyframes_are_aligned_as_they_come_and_together_at_the_end() -> None:
    link = FakeLink()
    session = session_of(link, wrong(), REFINE)
    finished(session)
    assert link.errors() == []
    first = {}
    for keyframe in link.of_type(KeyframeInfo):
        first.setdefault(keyframe.id, keyframe.T_world_camera)
    came, ended = list(first.values()), list(told_poses(link).values())
    assert (off(came) < 0.7 * off(disturbed(COUNT, 3))).all()
    assert (off(ended) < 0.5 * off(disturbed(COUNT, 3))).all()
    assert any(not np.array_equal(a, b) for a, b in zip(came, ended, strict=True)), "no round was made"
    assert_is_the_map_of_its_poses(session, link, list(range(COUNT)))
    activities = [status.activity for status in link.of_type(Status)]
    aligning = [i for i, text in enumerate(activities) if text.startswith("aligning all keyframes")]
    settling = [i for i, text in enumerate(activities) if text.startswith("sweeping keyframe 1 ")]
    read = [i for i, text in enumerate(activities) if text.startswith(f"reading frame {COUNT} of {COUNT}")]
    assert read[0] < aligning[0] < settling[-1]
    assert last_status(link).activity == "finding what is occupied"
    for keyframe in shown(link.sent).keyframes.values():
        np.testing.assert_array_equal(keyframe.T_home, keyframe.T_world_camera)


def test_live_places_keyframes_as_map_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "MOST_ROUNDS", 0)
    link = FakeLink()
    finished(session_of(link, wrong(), REFINE))
    mapped = map_sequence(wrong(), REFINE)
    for change in mapped.poses:
        np.testing.assert_allclose(told_poses(link)[change.keyframe], change.T_refined, atol=1e-9)


def test_an_edit_in_the_rounds_is_carried_out_at_once_and_they_begin_anew() -> None:
    T = moved(disturbed(COUNT, 3)[3], [0.3, 0, 0, 0, 0, 0])
    link = FakeLink(asking("aligning all keyframes", Move(3, T)))
    session = session_of(link, wrong(), REFINE)
    finished(session)
    assert link.errors() == []
    np.testing.assert_array_equal(told_poses(link)[3], T)
    assert_is_the_map_of_its_poses(session, link, list(range(COUNT)))
    activities = [status.activity for status in link.of_type(Status)]
    assert activities.count("sweeping aligned keyframes") > COUNT, "they were not begun anew"


def test_questions_are_answered_in_the_rounds() -> None:
    link = FakeLink(asking("aligning all keyframes", PixelRay(1, 80.0, 60.0)))
    finished(session_of(link, wrong(), REFINE))
    asked = next(i for i, u in enumerate(link.sent) if isinstance(u, RayAnswer))
    assert any(isinstance(u, Status) and u.activity.startswith("aligning") for u in link.sent[asked:])


def test_a_stop_in_the_rounds_takes_them_back() -> None:
    link = FakeLink()
    session = session_of(link, wrong(), REFINE)
    m = session.state.mapper
    session.run(lambda: len(link.of_type(KeyframeInfo)) > COUNT)  # the first that a round has moved
    assert not session.state.is_done
    assert m.unaligned
    first = {}
    for keyframe in link.of_type(KeyframeInfo):
        first.setdefault(keyframe.id, keyframe.T_world_camera)
    for id, T in told_poses(link).items():
        np.testing.assert_array_equal(T, first[id])


def test_off_and_on_and_reset_keep_to_what_was_aligned() -> None:
    link = FakeLink()
    session = session_of(link, wrong(), REFINE)
    finished(session)
    before = told_poses(link)
    link.ask(Switch(2, on=False), Switch(2, on=True))
    finished(session)
    np.testing.assert_array_equal(told_poses(link)[2], before[2])
    assert_is_the_map_of_its_poses(session, link, list(range(COUNT)))
    link.ask(Reset())
    finished(session)
    assert list(shown(link.sent).keyframes) == list(range(COUNT, 2 * COUNT))
    for id, T in before.items():
        np.testing.assert_allclose(told_poses(link)[COUNT + id], T, atol=1e-9)


def test_frozen_keyframes_stay_and_the_others_are_aligned_with_them() -> None:
    link = FakeLink()
    finished(session_of(link, wrong(), REFINE, keep_live=2))
    assert link.errors() == []
    states = [keyframe.state for keyframe in shown(link.sent).keyframes.values()]
    assert states == ["frozen"] * (COUNT - 2) + ["on"] * 2
    assert (off(list(told_poses(link).values())) < 0.8 * off(disturbed(COUNT, 3))).all()


def test_only_mrf_maps_can_refine() -> None:
    with pytest.raises(ConfigError, match=r"poses\.refine needs the method mrf"):
        session_of(FakeLink(), wrong(), replace(REFINE, method="visibility"))


def test_both_commands_take_the_flag() -> None:
    for command in (Live("a", poses=PoseFlags(refine_poses=True)), Map("a", Path(), poses=PoseFlags(True))):
        assert command.poses.parameters(command.settings).poses.refine
    assert not PoseFlags().parameters(Config()).poses.refine


def tracked_session(link: FakeLink, dataset: Dataset) -> Session:
    tracked = replace(source(dataset, tracked_room.CONFIG), tracked=True)
    return Session(tracked, link, Policy(leave_when_done=True))


def test_a_tracked_camera_gives_the_map_and_the_poses_of_its_batch_run(tmp_path: Path) -> None:
    """Those of held-out frames too."""
    config = replace(tracked_room.CONFIG, evaluation=EvaluationConfig(hold_out=4))
    dataset, link = walk(range(12)), FakeLink()
    replayed = replace(
        source(dataset, config), new_replay=lambda: Replay(dataset), tracked=True, dataset=dataset
    )
    session = Session(replayed, link, Policy(out=tmp_path, leave_when_done=True))
    finished(session)
    assert link.errors() == []
    batch = map_sequence(walk(range(12)), config)
    result = session.state.result()
    assert marginals(result.map) == marginals(batch.map)
    assert result.held_out == batch.held_out == [2, 6, 10]
    report, _ = write_run(tmp_path, result, session.state.facts, pictures=False)
    assert report["accuracy"]["frames"] == 3
    found = read_timed_poses(tmp_path / TRAJECTORY_FILE)
    assert len(found) == 12
    assert errors(dict(enumerate(found.poses)))[:, 1].max() < 0.05


def test_the_page_is_told_once_that_tracking_is_lost_and_that_it_goes_on() -> None:
    link = FakeLink()
    lost = {4: nowhere(), 5: nowhere()}
    tracked_session(link, walk(range(8), lost)).run(never)
    notices = [notice.text for notice in link.of_type(Notice)]
    assert len(notices) == 2
    assert "walk-004: tracking lost" in notices[0]
    assert "bring the camera back" in notices[0]
    assert notices[1] == "walk-006: tracking goes on after 2 lost frames"
    cameras = [camera.name for camera in link.of_type(CurrentCamera)]
    assert "walk-004" not in cameras
    assert "walk-007" in cameras


def test_keyframes_that_a_loop_moves_are_shown_where_they_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Closure] = []

    def close(self: LoopCloser, id: int) -> Closure | None:
        m = self._map
        if id != 2:
            return None
        T = {1: moved(m.keyframes[1].T_world_camera, [0.02, 0, 0, 0, 0, 0.01])}
        closed.append(Closure(2, 0, 0.02, 0.01, m.update_poses(T).moved))
        return closed[0]

    monkeypatch.setattr(LoopCloser, "took", close)
    link = FakeLink()
    session = tracked_session(link, walk(range(12)))
    session.run(never)
    assert closed[0].moved == (1,)
    notices = [m.text for m in link.sent if isinstance(m, Notice)]
    assert "loop closed: the camera was off by 2 cm, 1 keyframe moved" in notices
    last = {m.id: m for m in link.sent if isinstance(m, KeyframeInfo)}
    for entry in session.state.mapper.roster.entries.values():
        assert entry.map_id is not None
        T = session.state.mapper.map.keyframes[entry.map_id].T_world_camera
        np.testing.assert_array_equal(last[entry.id].T_world_camera, T)
    assert session.state.result().loops_closed == 1
    assert_shown_is(session, link)
