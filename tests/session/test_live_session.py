"""A live session against a viewer that is only a list: what is published, and what becomes of requests."""

import dataclasses
import json
from pathlib import Path

import live_scene
import numpy as np
import pytest
import small_room
from live_scene import (
    CONFIG,
    FakeLink,
    assert_shown_is,
    during_settling,
    finished,
    last_status,
    map_voxels,
    marginals,
    never,
    room,
    session_of,
    shown,
    source,
)

from taichi_mrf.config.schema import Config, VolumeConfig
from taichi_mrf.errors import CapacityError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import Source, open_source
from taichi_mrf.viewer.messages import (
    Bricks,
    File,
    Freeze,
    Hello,
    Images,
    KeyframeInfo,
    Move,
    Notice,
    Pause,
    PixelRay,
    Quit,
    RayAnswer,
    RayThrough,
    Request,
    Reset,
    Save,
    Speed,
    Status,
    Step,
    Switch,
    Update,
    Watch,
)

pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_run_ends_in_the_map_of_its_frames() -> None:
    link = FakeLink()
    session = session_of(link)
    assert marginals(finished(session)) == marginals(small_room.build(range(4)))
    assert_shown_is(session, link)
    assert isinstance(link.sent[0], Hello)
    assert [k.name for k in link.of_type(KeyframeInfo)] == [f.name for f in small_room.frames()[:4]]
    status = last_status(link)
    assert (status.frame, status.frames, status.keyframes, status.finished) == (4, 4, 4, True)
    assert not status.pending
    assert link.errors() == []


def test_the_number_of_keyframes_that_see_a_voxel_is_that_of_their_messages() -> None:
    link = FakeLink()
    link.ask(Watch(images=False, view=None, baseline=False, counts=True))
    m = finished(session_of(link))
    seen = shown(link.sent).bricks["map"]
    pool = m.view.pool
    expected = {tuple(brick): np.zeros(512, int) for brick in pool.bricks[pool.in_use].tolist()}
    for keyframe in m.keyframes.values():
        said = keyframe.messages.to_numpy().reshape(-1, 512) != 0
        for slot, row in zip(keyframe.visible.slots, said, strict=False):
            expected[tuple(pool.bricks[slot].tolist())] += row
    assert max(row.max() for row in expected.values()) > 1
    for brick, row in expected.items():
        np.testing.assert_array_equal(seen[brick][1], row)


@pytest.mark.parametrize(
    ("request_", "kind"),
    [
        (PixelRay(1, 80.0, 60.0), RayAnswer),
        (Watch(images=True, view=0, baseline=False), Images),
        (Save("map", 7), File),
        (Save("ply", 7), File),
        (Speed(2.0), Status),
        (Pause(True), Status),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, type) else "",
)
def test_full_inference_answers_from_the_map_as_it_was(request_: Request, kind: type[Update]) -> None:
    link = FakeLink(during_settling(request_))
    session = session_of(link)
    m = finished(session)
    sweeps = [i for i, u in enumerate(link.sent) if isinstance(u, Status) and u.activity[:8] == "sweeping"]
    assert len(sweeps) == 12, "it was not begun anew"
    between = link.sent[sweeps[1] : sweeps[-1]]
    assert any(isinstance(update, kind) for update in between)
    assert not any(isinstance(update, Bricks) for update in between), "nothing half-done is published"
    assert marginals(m) == marginals(small_room.build(range(4)))


def test_a_map_whose_inference_was_stopped_is_shown_as_saved_and_a_notice_says_so(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    m = small_room.build(range(3))
    whole = map_voxels(m)
    m.infer(sweeps=1)
    m.save(path)
    saved = map_voxels(m.layer())
    assert saved != whole
    link = FakeLink()
    opened = Source("map.npz", CONFIG, lambda: load_map(path))
    session = Session(opened, link, Policy(leave_when_done=True))
    (notice,) = link.of_type(Notice)
    assert notice.text.startswith("map.npz was saved before its inference was complete")
    assert shown(link.sent).voxels() == saved
    session.run(never)
    assert shown(link.sent).voxels() == whole
    m.infer()
    m.save(path)
    link = FakeLink()
    Session(opened, link, Policy(leave_when_done=True))
    assert not link.of_type(Notice)


def test_a_saved_map_is_done_at_once_and_an_edit_brings_its_messages(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    small_room.build(range(3)).save(path)
    link = FakeLink()
    opened, notes = open_source(str(path), Config(), every=1, limit=None, speed=0.0, loop=False)
    assert "its own parameters" in notes[0]
    session = Session(opened, link, Policy(leave_when_done=True))
    assert link.of_type(Bricks) == [], "nothing is shown before what is occupied"
    mapped = finished(session)
    assert session.state.is_done
    assert session.state.mapper.inferred is None
    assert not any(isinstance(u, Status) and u.activity.startswith("sweeping") for u in link.sent)
    assert marginals(mapped) == marginals(small_room.build(range(3)))
    whole = map_voxels(mapped)
    assert shown(link.sent).voxels() == map_voxels(small_room.build(range(3)))
    assert session.state.mapper.inferred is None
    link.ask(Watch(images=False, view=None, baseline=False), Switch(2, on=False))
    assert marginals(finished(session)) == marginals(small_room.build(range(2)))
    assert shown(link.sent).voxels() == map_voxels(small_room.build(range(2))) != whole
    assert_shown_is(session, link)
    assert link.errors() == []


def test_what_messages_tell_brings_the_messages_of_a_saved_map(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    small_room.build(range(3)).save(path)
    link = FakeLink()
    session = Session(Source("map.npz", CONFIG, lambda: load_map(path)), link, Policy(leave_when_done=True))
    finished(session)
    link.ask(Watch(images=False, view=None, baseline=False, counts=True))
    mapped = finished(session)
    slots = mapped.view.pool.in_use
    assert mapped.seen_by(slots).max() == 3
    assert session.state.mapper.inferred is not None


def test_a_map_saved_during_inference_is_the_one_that_is_shown(tmp_path: Path) -> None:
    link = FakeLink(during_settling(Save("map", 7)))
    session = session_of(link)
    finished(session)
    (file,) = link.of_type(File)
    assert (file.name, file.client) == ("map.npz", 7)
    path = tmp_path / file.name
    path.write_bytes(file.content)
    saved = link.sent.index(file)
    assert map_voxels(MRFMap.load(path).layer()) == shown(link.sent[:saved]).voxels()


def test_a_stop_during_full_inference_leaves_the_map_that_was_shown() -> None:
    link = FakeLink()
    session = session_of(link)
    session.run(lambda: any(s.activity.startswith("sweeping keyframe 3 ") for s in link.of_type(Status)[-1:]))
    assert not session.state.is_done
    assert_shown_is(session, link, decided=False)
    assert marginals(finished(session)) == marginals(small_room.build(range(4)))


def test_a_stop_after_the_first_sweep_keeps_what_was_computed() -> None:
    link = FakeLink()
    session = session_of(link)
    second = "sweeping keyframe 2 of 4 (sweep 2 of 3)"
    session.run(lambda: any(s.activity == second for s in link.of_type(Status)[-1:]))
    assert not session.state.is_done
    assert session.state.result().sweeps == 2
    assert_shown_is(session, link, decided=False)
    twin = small_room.build(range(4))
    twin.infer(progress=lambda step: (step.sweep, step.keyframe) != (2, 2))
    assert marginals(session.state.mapper.map) == marginals(twin)
    assert marginals(finished(session)) == marginals(small_room.build(range(4)))


def test_a_paused_run_takes_one_keyframe_a_step() -> None:
    link = FakeLink()
    session = session_of(link)
    link.ask(Pause(True))
    session.run(lambda: link.waits > 0)
    assert link.of_type(KeyframeInfo) == []
    assert last_status(link).paused
    for steps in (1, 2):
        link.ask(Step())
        waits = link.waits
        session.run(lambda waits=waits: link.waits > waits)
        assert len(link.of_type(KeyframeInfo)) == steps
        assert marginals(session.state.mapper.map) == marginals(small_room.build(range(steps)))
    link.ask(Pause(False))
    assert marginals(finished(session)) == marginals(small_room.build(range(4)))


def test_going_on_does_not_wait_for_full_inference() -> None:
    asked: list[Request] = [Pause(False)]

    def react(update: Update) -> list[Request]:
        if isinstance(update, KeyframeInfo) and update.id == 1:
            return [Pause(True)]
        if (
            isinstance(update, Status)
            and update.activity == "sweeping keyframe 1 of 2 (sweep 1 of 3)"
            and asked
        ):
            return [asked.pop()]
        return []

    link = FakeLink(react)
    assert marginals(finished(session_of(link))) == marginals(small_room.build(range(4)))
    activities = [status.activity for status in link.of_type(Status)]
    broken_off = activities.index("sweeping keyframe 1 of 2 (sweep 1 of 3)")
    assert activities[broken_off + 1] == "reading frame 3 of 4"


def test_a_broken_frame_gives_a_notice_and_mapping_goes_on() -> None:
    link = FakeLink()
    session = session_of(link, room(4, broken=(1, 2)))
    assert marginals(finished(session)) == marginals(small_room.build([0, 3]))
    assert link.errors() == [f"{room().frame_names[i]}: the image is damaged" for i in (1, 2)]


def test_a_full_map_pauses_with_a_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    add = MRFMap.add_keyframe

    def full(self: MRFMap, *arguments: object, **named: object) -> int:
        if len(self.keyframes) == 2:
            raise CapacityError("the map would not fit")
        return add(self, *arguments, **named)

    monkeypatch.setattr(MRFMap, "add_keyframe", full)
    link = FakeLink()
    session = session_of(link)
    session.run(lambda: link.waits > 0)
    name = small_room.frames()[2].name
    assert link.errors() == [f"frame {name} does not fit: the map would not fit"]
    assert last_status(link).paused
    assert marginals(session.state.mapper.map) == marginals(small_room.build(range(2)))
    assert session.state.full in link.errors()


def test_a_run_that_nobody_watches_ends_when_the_map_is_full() -> None:
    volume = VolumeConfig(memory_limit_gb=1.4e-3)
    link = FakeLink()
    session = session_of(link, room(10), dataclasses.replace(CONFIG, volume=volume))
    session.state.policy = Policy(leave_when_done=True)
    session.run(lambda: link.waits > 3)
    mapped = session.state.mapper.map
    count = len(mapped.keyframes)
    assert 0 < count < 10
    assert f"frame {small_room.frames()[count].name} does not fit" in str(session.state.full)
    assert not session.state.mapper.unsettled
    assert marginals(mapped) == marginals(small_room.build(range(count)))


@pytest.mark.parametrize(
    "request_",
    [
        Switch(99, on=False),
        Freeze(-1),
        Move(99, np.eye(4)),
        Move(0, np.full((4, 4), np.nan)),
        Speed(float("nan")),
        PixelRay(0, -5.0, 3.0),
        PixelRay(0, float("nan"), 3.0),
        RayThrough((float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0), None),
        RayThrough((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 99),
    ],
)
def test_an_impossible_request_becomes_a_notice_and_changes_nothing(request_: Request) -> None:
    link = FakeLink()
    session = session_of(link, room(2))
    before = marginals(finished(session))
    link.ask(request_)
    assert marginals(finished(session)) == before
    assert len(link.errors()) == 1


def test_reset_begins_anew_with_new_numbers() -> None:
    link = FakeLink()
    session = session_of(link)
    finished(session)
    link.ask(Reset())
    assert marginals(finished(session)) == marginals(small_room.build(range(4)))
    assert len(link.of_type(Hello)) == 2
    assert list(shown(link.sent).keyframes) == [4, 5, 6, 7]
    assert_shown_is(session, link)


def test_many_resets_do_not_run_out_of_maps() -> None:
    link = FakeLink()
    session = session_of(link, room(1))
    for _ in range(70):
        link.ask(Reset())
        session.run(lambda: not len(session.state.waiting) and session.state.is_done)
    assert link.errors() == []


@pytest.mark.parametrize("method", ["log_odds", "visibility"])
def test_methods_that_cannot_take_a_scan_back_are_made_anew(method: str) -> None:
    config = Config(voxel_size=0.1, method=method, evaluation=CONFIG.evaluation)
    link = FakeLink()
    session = session_of(link, config=config)
    session.run(never)
    link.ask(Switch(1, on=False))
    session.run(never)
    expected = create_map(config, small_room.frames()[0].camera)
    for i in (0, 2, 3):
        small_room.add(expected, small_room.frames()[i])
    assert marginals(session.state.mapper.map) == marginals(expected)
    assert_shown_is(session, link)
    assert link.errors() == []


def test_frames_that_are_held_out_stay_out() -> None:
    config = Config(voxel_size=CONFIG.voxel_size)
    link = FakeLink()
    session_of(link, room(10), config).run(never)
    names = [frame.name for frame in small_room.frames()]
    assert [k.name for k in link.of_type(KeyframeInfo)] == [n for i, n in enumerate(names) if i != 5]


def test_a_new_viewer_is_told_everything() -> None:
    first, second = FakeLink(), FakeLink()
    session = session_of(first, keep_live=3)
    finished(session)
    session.reconnect(second)
    assert isinstance(second.sent[0], Hello)
    assert_shown_is(session, second)
    assert list(shown(second.sent).keyframes) == [0, 1, 2, 3]


@pytest.mark.parametrize("lost", [True, False], ids=["lost", "quit"])
def test_a_viewer_that_goes_ends_the_run(lost: bool) -> None:
    link = FakeLink()
    session = session_of(link)
    if lost:
        link.lost = "gone"
    else:
        link.ask(Quit())
    session.run(never)
    assert not session.state.is_done


def test_a_defect_in_inference_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def defect(m: OccupancyMap, keep_before: bool) -> None:
        raise RuntimeError("something is wrong")

    monkeypatch.setattr("taichi_mrf.session.mapper.FullInference", defect)
    link = FakeLink()
    session_of(link, room(2)).run(never)
    assert link.errors() == ["something is wrong"]


def test_what_is_sent_for_a_keyframe_is_what_changed() -> None:
    link = FakeLink()
    session = Session(source(room()), link, Policy())
    session.run(lambda: link.waits > 0)
    view = live_scene.Shown()
    for update in link.sent:
        if isinstance(update, Bricks):
            known = view.bricks.get("map", {})
            for brick, log_odds, seen in zip(
                update.bricks.tolist(), update.log_odds, update.seen, strict=True
            ):
                old = known.get(tuple(brick))
                assert old is None or (old[0] != log_odds).any() or (old[1] != seen).any()
        view.hear(update)
    assert any(isinstance(update, Notice) for update in link.sent) is False


def test_a_signal_is_noticed_between_any_two_requests() -> None:
    link = FakeLink()
    session = session_of(link, room(3))
    finished(session)
    link.ask(*(Save("map", client) for client in range(50)))
    session.run(lambda: len(link.of_type(File)) >= 2)
    assert len(link.of_type(File)) == 2


def test_clients_that_never_stop_moving_a_keyframe_do_not_stop_mapping(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("taichi_mrf.session.session.REQUEST_SECONDS", 0.0)
    T = small_room.frames()[0].T_world_camera
    link = FakeLink()
    session = session_of(link, room(4))

    def over() -> bool:
        mapper = session.state.mapper
        link.ask(*(Move(id, T) for id in mapper.roster.entries for _ in range(10)))
        return len(mapper.roster.entries) == 4 and len(session.state.waiting) > 0

    session.run(over)
    assert len(session.state.mapper.map.keyframes) == 4
    assert link.errors() == []


def test_150_presses_of_save_are_one(tmp_path: Path) -> None:
    link = FakeLink()
    session = Session(source(room(3)), link, Policy(out=tmp_path, leave_when_done=True))
    finished(session)
    link.ask(*[Save("map", 7)] * 150)
    finished(session)
    assert len(link.of_type(File)) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"map.npz", "config.yaml", "report.json"}
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["keyframes"], report["frames"], report["interrupted"]) == (3, 3, False)
