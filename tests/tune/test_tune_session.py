"""A tuning session with a test at the other end of the line: latest wins, pin, save, other frames, search."""

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from live_scene import FakeLink, shown
from tune_scene import CHOICE, CONFIG, room, working_set

from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig, load
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.session.session_core import Policy
from taichi_mrf.tune.link import TuneOutbox
from taichi_mrf.tune.search import Search
from taichi_mrf.tune.session import TuneSession
from taichi_mrf.tune.trial import run_trial
from taichi_mrf.viewer.messages import Bricks, File, Hello, KeyframeInfo, Notice, Quit, Request, Update
from taichi_mrf.viewer.tune.messages import (
    Activity,
    ChooseFrames,
    Chosen,
    FrameChoice,
    HeldOutView,
    LookAt,
    Pin,
    Pinned,
    Residuals,
    SaveTries,
    StopSearch,
    Tried,
    Try,
    Tuning,
    Verdict,
)


def with_density(density: float) -> Config:
    return dataclasses.replace(CONFIG, inference=InferenceConfig(surface_density=density))


def is_at_rest(update: Update) -> bool:
    return isinstance(update, Activity) and not update.busy


def script(*steps: Request | list[Request]) -> Callable[[Update], Iterable[Request]]:
    """Asks for the next step each time that the session rests, and at last to end."""
    left = list(steps)

    def react(update: Update) -> Iterable[Request]:
        if not is_at_rest(update):
            return []
        step = left.pop(0) if left else Quit()
        return step if isinstance(step, list) else [step]

    return react


def run(
    react: Callable[[Update], Iterable[Request]], search: Search | None = None, out: Path | None = None
) -> tuple[TuneSession, FakeLink]:
    link = FakeLink(react)
    session = TuneSession(room(), CONFIG, CHOICE, link, Policy(out), search=search)
    session.run(lambda: False)
    return session, link


def test_a_session_begins_with_a_try_of_where_it_stands() -> None:
    session, link = run(script())
    assert isinstance(link.sent[0], Tuning)
    assert link.of_type(Tuning)[0].held_out == ("room-0001", "room-0004", "room-0007")
    (tried,) = link.of_type(Tried)
    assert (tried.number, tried.config, tried.by) == (0, CONFIG, "start")
    assert link.of_type(Pinned) == [Pinned(0)]
    assert link.of_type(Chosen)[0].number == link.of_type(Residuals)[0].number == 0
    assert len(link.of_type(KeyframeInfo)) == 6
    direct = run_trial(CONFIG, session.frames)
    assert direct is not None
    same = dataclasses.replace(tried.scores, seconds=direct.scores.seconds)
    assert same == direct.scores


def test_the_map_on_the_page_is_that_of_the_last_try() -> None:
    session, link = run(script(Try(with_density(6.0))))
    direct = run_trial(with_density(6.0), session.frames)
    assert direct is not None
    occupied = len(direct.map.marginals.voxels(0.5)[0])
    assert len(shown(link.sent).voxels()) == occupied
    first = next(i for i, u in enumerate(link.sent) if isinstance(u, Bricks)) + 1
    assert len(shown(link.sent[:first]).voxels()) != occupied


def test_a_map_on_the_same_grid_takes_the_place_of_the_one_before_without_a_new_beginning() -> None:
    wide = dataclasses.replace(CONFIG, sensor=SensorConfig(sigma=(0.05,)))
    sharp = dataclasses.replace(CONFIG, sensor=SensorConfig(sigma=(0.001,)))
    session, link = run(script(Try(wide), Try(sharp)))
    assert len(link.of_type(Hello)) == 1
    direct = run_trial(sharp, session.frames)
    assert direct is not None
    bricks = {len(shown(link.sent[:i]).bricks.get("map", ())) for i in range(len(link.sent))}
    assert len(bricks) > 2  # some are gone, too
    assert len(shown(link.sent).bricks["map"]) == direct.map.statistics().bricks
    assert len(shown(link.sent).voxels()) == len(direct.map.marginals.voxels(0.5)[0])


def test_newer_parameters_end_a_try_at_once_and_the_latest_wins() -> None:
    newer = [Try(with_density(d)) for d in (3.0, 4.0, 5.0)]
    busy: list[str] = []

    def react(update: Update) -> Iterable[Request]:
        if is_at_rest(update):
            return [Quit()]
        if isinstance(update, Activity):
            busy.append(update.text)
            if update.text.startswith("adding room-0002") and newer:
                asked, newer[:] = list(newer), []
                return asked
        return []

    session, link = run(react)
    assert [each.config for each in session.history.attempts] == [with_density(5.0)]
    # The first try went no further than the keyframe at which it was overtaken.
    assert busy.index("adding room-0000", 1) == busy.index("adding room-0002") + 1
    assert link.errors() == []


def test_a_parameter_that_cannot_be_mapped_with_becomes_a_notice() -> None:
    tiny = dataclasses.replace(CONFIG, volume=VolumeConfig(memory_limit_gb=1e-6))
    session, link = run(script(Try(tiny), Try(with_density(3.0))))
    assert len(link.errors()) == 1
    assert [each.config for each in session.history.attempts] == [CONFIG, with_density(3.0)]


def test_pinning_compares_with_another_try() -> None:
    _, link = run(script(Try(with_density(8.0)), Pin(1), Pin(7)))
    assert link.of_type(Pinned)[-1] == Pinned(1)
    last = link.of_type(HeldOutView)[-1]
    assert last.title == last.reference_title
    assert last.change_title == ""
    before = next(view for view in link.of_type(HeldOutView) if view.title.startswith("try 1"))
    assert before.reference_title.startswith("try 0")
    assert "became right" in before.change_title
    assert before.accuracy.shape == before.measured.shape == (60, 80 + 3 + 80, 3)
    assert link.errors() == ["there is no try 7"]


def test_another_held_out_view_is_shown_on_request() -> None:
    _, link = run(script(LookAt(2), LookAt(3)))
    assert [view.name for view in link.of_type(HeldOutView)] == ["room-0001", "room-0007"]
    assert link.errors() == ["there is no held-out view 3"]


def test_restoring_a_try_adds_none() -> None:
    session, link = run(script(Try(with_density(3.0)), Try(CONFIG)))
    assert len(session.history.attempts) == 2
    assert link.of_type(Chosen)[-1] == Chosen(0, CONFIG)


def test_saved_files_go_to_the_client_and_to_the_folder(tmp_path: Path) -> None:
    _, link = run(script(SaveTries("yaml", 0, 5), SaveTries("csv", 0, 5)), out=tmp_path)
    files = link.of_type(File)
    assert [(file.name, file.client) for file in files] == [("try-0.yaml", 5), ("tries.csv", 5)]
    for file in files:
        assert (tmp_path / file.name).read_bytes() == file.content
    assert load(tmp_path / "try-0.yaml") == CONFIG


def test_other_frames_begin_a_new_table_with_the_parameters_in_force() -> None:
    choice = FrameChoice(first=1, stride=2, count=4, hold_out=2)
    session, link = run(script(Try(with_density(3.0)), ChooseFrames(choice)))
    assert len(link.of_type(Tuning)) == 2
    assert link.of_type(Tuning)[1].config == with_density(3.0)
    assert [each.config for each in session.history.attempts] == [with_density(3.0)]
    assert len(session.frames.training) == len(session.frames.held_out) == 2
    _, link = run(script(ChooseFrames(FrameChoice(first=40))))
    assert link.errors() == ["the first frame must lie between 0 and 8, not 40"]
    assert len(link.of_type(Tuning)) == 1


def test_a_search_is_made_and_judged_on_views_that_it_has_not_seen() -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    search = Search(CONFIG, ("inference.surface_density", "sensor.sigma_scale"), 4, seed=0)
    session, link = run(script(), search)
    assert search.told == 4
    shares = [each.share for each in link.of_type(Activity) if each.text.startswith("search, 3 of 4")]
    assert 0.5 <= min(shares) < max(shares) <= 0.75  # of the whole search, not of its third map
    assert [frame.name for frame in session.frames.unseen] == ["room-0004"]
    assert {each.by for each in session.history.attempts} == {"start", "search"}
    best = max(link.of_type(Tried), key=lambda each: each.scores.log_likelihood)
    assert best.config == search.best
    assert link.of_type(Chosen)[-1].config == search.best
    assert list(link.of_type(Verdict)[-1].scores) == ["shipped defaults", "found"]
    assert link.of_type(Verdict)[-1].views == 1
    assert any("that were never looked at before" in notice.text for notice in link.of_type(Notice))


def test_the_verdict_is_told_when_the_search_ends_and_not_when_the_session_does() -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    search = Search(CONFIG, ("inference.surface_density",), 2, seed=0)
    link, told = FakeLink(), list[list[str]]()
    session = TuneSession(
        room(),
        CONFIG,
        CHOICE,
        link,
        Policy(),
        search=search,
        judged=told.append,
    )
    session.run(lambda: link.waits > 0)
    assert told == [session.verdict]
    assert "found" in told[0][1]
    assert not session.ended


def test_a_person_comes_before_the_search_and_can_end_it() -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    search = Search(CONFIG, ("inference.surface_density",), 50, seed=0)
    asked = [[Try(with_density(9.0))], [StopSearch()]]

    def react(update: Update) -> Iterable[Request]:
        if is_at_rest(update):
            return [Quit()]
        second = isinstance(update, Activity) and update.text.startswith("search, 2 of 50: sweep")
        by_hand = isinstance(update, Tried) and update.by == "hand"
        return asked.pop(0) if asked and (second if len(asked) == 2 else by_hand) else []

    session, _ = run(react, search)
    assert any(each.config == with_density(9.0) for each in session.history.attempts)
    assert search.told < 5
    assert session.verdict


def test_tries_that_wait_for_the_page_outlive_a_new_map_but_not_new_frames() -> None:
    outbox = TuneOutbox()
    scores = run_trial(CONFIG, working_set()).scores
    hello = Hello("", "", "", "mrf", 0.1, 0.0, 0.0, "")
    tuning = Tuning("", "", "", CONFIG, CHOICE, 9, (), (), ())
    for update in (
        tuning, Activity("a", 0.0, True), Tried(0, CONFIG, scores, "start"), Activity("b", 0.5, True), hello,
        Tried(0, CONFIG, scores, "hand"), Tried(1, CONFIG, scores, "hand"), hello,
    ):  # fmt: skip
        outbox.put(update)
    taken = [outbox.take() for _ in range(len(outbox))]
    assert [type(update) for update in taken] == [Tuning, Activity, Tried, Tried, Hello]
    assert taken[1].text == "b"
    for update in (Tried(0, CONFIG, scores, "start"), Activity("a", 0.0, True), Notice("n"), tuning):
        outbox.put(update)
    assert [type(outbox.take()) for _ in range(len(outbox))] == [Notice, Tuning]
