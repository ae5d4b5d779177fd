"""The live page's past and present: what is sent of a map whose world may change, and what is listed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_room
from inputs_frames import Frames, of_frames
from live_scene import CONFIG, FakeLink, Shown, finished, map_voxels, session_of, shown

from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.reading import MapReading
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.run import PLAY_STEPS
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.shown_map import ShownMap
from taichi_mrf.session.source import Source
from taichi_mrf.viewer.messages import Bricks, SceneChanges, ShowTime, Switch, TimeSpan

pytestmark = pytest.mark.usefixtures("one_backend")

DATED = replace(CONFIG, time=TimeConfig(half_life_s=600.0))
START_S, EMPTY, FRAMES = 100.0, 4, 7


def frame(index: int) -> Frame:
    """The first frame, a second apart; from EMPTY on something stands halfway between camera and wall."""
    first = small_room.frames()[0]
    depth_m = first.depth_m.copy()
    if index >= EMPTY:
        height, width = depth_m.shape
        depth_m[height // 3 : 2 * height // 3, 3 * width // 8 : 5 * width // 8] *= 0.5
    return replace(first, depth_m=depth_m, stamp=START_S + index, name=f"room {index}")


def visited(count: int = FRAMES) -> Frames:
    """The frames above."""
    return of_frames([frame(index) for index in range(count)])


def visited_map(time: TimeConfig) -> MRFMap:
    m = MRFMap(small_room.VOXEL_SIZE, time=time)
    for i in range(FRAMES):
        f = frame(i)
        m.add_keyframe(f.depth_m, f.T_world_camera, f.camera, f.name, f.stamp)
    m.infer()
    return m


def hear(view: Shown, shown_map: ShownMap, renewed: bool = False) -> Shown:
    """Send what has changed, and what is occupied, as a page that is at rest has it."""
    for bricks in shown_map.renew() if renewed else shown_map.changes():
        view.hear(bricks)
    if shown_map.lacks_decisions:
        for bricks in shown_map.decide(lambda: None):
            view.hear(bricks)
    return view


def voxels(m: MRFMap | MapReading) -> set[tuple[int, int, int]]:
    return map_voxels(m)


def test_the_past_is_sent_and_the_present_comes_back() -> None:
    m = visited_map(DATED.time)
    shown_map, before_s = ShownMap(m), START_S + EMPTY - 1
    view = hear(Shown(), shown_map)
    now, then = voxels(m), voxels(m.at(before_s))
    assert len(now - then) > 20
    assert view.voxels() == now
    assert view.voxels("dynamic") == voxels(m.dynamic)
    assert len(view.voxels("dynamic") & (now - then)) > 20
    shown_map.show(before_s)
    assert hear(view, shown_map, renewed=True).voxels() == then
    assert not view.voxels("dynamic") & (now - then)
    assert shown_map.changes() == []
    assert shown_map.renew() == []  # a moment has not gone by
    shown_map.show(None)
    assert hear(view, shown_map, renewed=True).voxels() == now
    assert view.voxels("dynamic") == voxels(m.dynamic)


def test_the_past_follows_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taichi_mrf.session.shown_map.RENEW_SECONDS", 0.0)
    m = visited_map(DATED.time)
    shown_map, before_s = ShownMap(m), START_S + EMPTY - 1
    view = hear(Shown(), shown_map)
    shown_map.show(before_s)
    hear(view, shown_map, renewed=True)
    other = small_room.frames()[3]
    m.add_keyframe(other.depth_m, other.T_world_camera, other.camera, "another view", START_S)
    m.infer()
    hear(view, shown_map)
    assert view.voxels() != voxels(m.at(before_s))
    assert hear(view, shown_map, renewed=True).voxels() == voxels(m.at(before_s))


def test_a_static_map_has_no_past() -> None:
    m = visited_map(TimeConfig())
    shown_map = ShownMap(m)
    view = hear(Shown(), shown_map)
    shown_map.show(START_S)
    assert shown_map.stamp_s is None
    assert shown_map.renew() == []
    assert view.voxels() == voxels(m)
    assert "dynamic" not in view.bricks


def test_an_edit_returns_to_now() -> None:
    link = FakeLink()
    session = session_of(link, visited(), DATED)
    m = finished(session)
    spans = link.of_type(TimeSpan)
    last_s = START_S + FRAMES - 1
    assert (spans[-1].start_s, spans[-1].first_s, spans[-1].now_s) == (START_S, START_S, last_s)
    link.ask(ShowTime(START_S + EMPTY - 1))
    finished(session)
    session._extras.work(lambda step: True)
    assert link.of_type(TimeSpan)[-1].shown_s == START_S + EMPTY - 1
    assert shown(link.sent).voxels() == voxels(m.at(START_S + EMPTY - 1))
    link.ask(Switch(0, on=False))
    m = finished(session)
    assert link.of_type(TimeSpan)[-1].shown_s is None
    assert shown(link.sent).voxels() == voxels(m)


def test_the_past_is_played_until_now_or_an_edit() -> None:
    link = FakeLink()
    session = session_of(link, visited(), DATED)
    m = finished(session)
    for edit in (None, Switch(0, on=False)):
        before = len(link.of_type(TimeSpan))
        link.ask(ShowTime(START_S + EMPTY - 1, play=True))
        finished(session)
        for step in range(4 * PLAY_STEPS):
            session._extras.work(lambda step: True)
            if step == 20 and edit is not None:
                link.ask(edit)
                m = finished(session)
        times = [span.shown_s for span in link.of_type(TimeSpan)[before:]]
        past = [time for time in times if time is not None]
        assert past == sorted(set(past))
        assert len(past) > 5
        assert (past[-1] > START_S + FRAMES - 1.2) == (edit is None)
        assert times[len(past) :] == [None] * (len(times) - len(past)) != []
        assert shown(link.sent).voxels() == voxels(m)


def test_a_saved_map_is_done_at_once_with_what_moves_and_its_past_brings_its_messages(tmp_path: Path) -> None:
    path, before_s = tmp_path / "map.npz", START_S + EMPTY - 1
    m = visited_map(DATED.time)
    m.save(path)
    link = FakeLink()
    session = Session(Source("map.npz", DATED, lambda: load_map(path)), link, Policy(leave_when_done=True))
    assert link.of_type(Bricks) == [], "nothing is shown before what is occupied"
    finished(session)
    assert session.state.mapper.inferred is None
    assert shown(link.sent).voxels() == voxels(m)
    assert shown(link.sent).voxels("dynamic") == voxels(m.dynamic) != set()
    link.ask(ShowTime(before_s))
    finished(session)
    assert session.state.mapper.inferred is not None
    session._extras.work(lambda step: True)
    assert shown(link.sent).voxels() == voxels(m.at(before_s))
    assert link.errors() == []


def test_what_appears_is_listed_once_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taichi_mrf.session.shown_extras.SHARE_OF_TIME", 1.0)
    link = FakeLink()
    finished(session_of(link, visited(), DATED))
    (latest,) = [update.changes for update in link.of_type(SceneChanges)][-1:]
    appeared = [change for change in latest if change.verb == "appeared"]
    assert 1 <= len(appeared) <= 2
    assert START_S + EMPTY <= appeared[-1].stamp_s < START_S + FRAMES
    f = frame(EMPTY)
    v, u = f.camera.height // 2, f.camera.width // 2
    at = f.T_world_camera[:3, :3] @ (f.camera.rays()[v, u] * f.depth_m[v, u]) + f.T_world_camera[:3, 3]
    assert np.linalg.norm(np.array(appeared[-1].centre_m) - at) < 0.4


def test_nothing_is_listed_of_a_scene_in_which_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taichi_mrf.session.shown_extras.SHARE_OF_TIME", 1.0)
    link = FakeLink()
    finished(session_of(link, visited(EMPTY), DATED))
    assert link.of_type(SceneChanges) == []
