"""A folder with several recordings: what is listed, what a page may choose, and what becomes of the map."""

from pathlib import Path
from typing import Any

import inputs_frames
import numpy as np
import pytest
import small_room
from console import assert_refused, taichi_mrf
from live_scene import CONFIG, FakeLink, during_settling, finished, marginals, session_of, shown

from taichi_mrf.errors import DatasetError
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import Opened, open_among, open_source, recordings_in
from taichi_mrf.viewer.messages import Hello, KeyframeInfo, Notice, Reset, Status, Switch

pytestmark = pytest.mark.usefixtures("one_backend")


def write_frames(path: Path, *numbers: int) -> None:
    """A recording of some frames of the small room."""
    inputs_frames.write_frames(path, [small_room.frames()[number] for number in numbers])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings, one of them a level deeper, and a map; beside them what is neither."""
    folder = tmp_path / "all"
    write_frames(folder / "a" / "frames.npz", 0, 1, 2)
    write_frames(folder / "trip" / "b" / "frames.npz", 3, 4)
    write_frames(folder / "too" / "deep" / "to" / "frames.npz", 5)
    write_frames(folder / ".hidden" / "frames.npz", 5)
    write_frames(tmp_path / "outside" / "frames.npz", 5)
    (folder / "link").symlink_to(tmp_path / "outside")
    (folder / "trip" / "up").symlink_to(tmp_path)
    (folder / "run").mkdir()
    small_room.build(range(2)).save(folder / "run" / "map.npz")
    np.savez(folder / "run" / "other.npz", scans=np.zeros(3))
    (folder / "run" / "report.json").write_text("{}")
    return folder


NAMES = ("a", "run/map.npz", "trip/b")


def open_one(name: str) -> Opened:
    return open_source(name, CONFIG, every=1, limit=None, speed=0.0, loop=False)


def session_among(folder: Path, link: FakeLink) -> Session:
    source, _ = open_among(str(folder), open_one)
    return Session(source, link, Policy(leave_when_done=True))


def alone(path: Path) -> dict[int, bytes]:
    """The map of one recording that was opened by itself."""
    return marginals(finished(session_among(path, FakeLink())))


def test_recordings_and_maps_are_listed_to_two_levels_and_never_outside(folder: Path) -> None:
    assert recordings_in(folder) == NAMES
    assert recordings_in(folder / "a") == (), "it is a recording itself"
    assert recordings_in(folder / "run" / "map.npz") == ()


def test_the_first_is_mapped_and_another_takes_its_place(folder: Path) -> None:
    link = FakeLink()
    session = session_among(folder, link)
    first = finished(session)
    (hello,) = link.of_type(Hello)
    assert (hello.recordings, hello.recording) == (NAMES, 0)
    assert marginals(first) == alone(folder / "a")
    link.ask(Reset(2))
    assert marginals(finished(session)) == alone(folder / "trip" / "b")
    assert link.errors() == []
    hello = link.of_type(Hello)[-1]
    assert (hello.recordings, hello.recording, hello.has_frames) == (NAMES, 2, True)
    assert sorted(shown(link.sent).keyframes) == [3, 4], "numbers go on"
    link.ask(Reset())
    assert marginals(finished(session)) == alone(folder / "trip" / "b"), "Reset is of the one in force"
    link.ask(Reset(1))
    finished(session)
    assert session.state.source.new_replay is None
    assert "its own parameters" in link.of_type(Notice)[-1].text
    assert (link.of_type(Hello)[-1].recording, link.of_type(Hello)[-1].has_frames) == (1, False)


def test_another_recording_ends_inference_that_is_under_way(folder: Path) -> None:
    link = FakeLink(during_settling(Reset(2)))
    session = session_among(folder, link)
    assert marginals(finished(session)) == alone(folder / "trip" / "b")


def test_a_saved_map_is_left_without_its_inference(folder: Path) -> None:
    link = FakeLink()
    session = session_among(folder, link)
    link.ask(Reset(1))
    finished(session)
    assert session.state.mapper.lacks_messages
    begin = len(link.sent)
    link.ask(Switch(session.state.mapper.roster.next_id - 1, False), Reset(0))
    assert marginals(finished(session)) == alone(folder / "a")
    later = link.sent[begin:]
    anew = next(i for i, update in enumerate(later) if isinstance(update, Hello))
    assert not any(isinstance(u, Status) and u.activity.startswith("sweeping") for u in later[:anew])


@pytest.mark.parametrize("place", [-1, 3, 10**9, "../../outside", "a", 0.5])
def test_a_place_that_is_not_in_the_list_opens_nothing(folder: Path, place: Any) -> None:
    link, opened = FakeLink(), list[str]()

    def open_noted(name: str) -> Opened:
        opened.append(name)
        return open_one(name)

    source, _ = open_among(str(folder), open_noted)
    session = Session(source, link, Policy(leave_when_done=True))
    before = finished(session)
    link.ask(Reset(place))
    assert finished(session) is before
    assert opened == [str(folder / "a")]
    assert len(link.errors()) == 1


def test_a_single_source_has_no_others(tmp_path: Path) -> None:
    link = FakeLink()
    session = session_of(link)
    before = finished(session)
    assert link.of_type(Hello)[0].recordings == ()
    link.ask(Reset(0))
    assert finished(session) is before
    assert link.errors() == ["small room: there are no other recordings to choose from"]


def test_the_map_stays_if_another_recording_cannot_be_opened(folder: Path) -> None:
    link = FakeLink()
    session = session_among(folder, link)
    before, sent = finished(session), len(link.sent)
    (folder / "trip" / "b" / "frames.npz").write_bytes(b"no archive")
    link.ask(Reset(2))
    assert finished(session) is before
    assert len(link.errors()) == 1
    assert not any(isinstance(update, Hello | KeyframeInfo) for update in link.sent[sent:])


def test_the_first_that_can_be_opened_is_taken_and_the_user_is_told(folder: Path) -> None:
    (folder / "a" / "frames.npz").write_bytes(b"no archive")
    source, notes = open_among(str(folder), open_one)
    assert source.among is not None
    assert source.among.names[source.place] == "run/map.npz"
    assert "a/frames.npz" in notes[0]
    assert notes[1] == f"{folder} holds 3 recordings: this is run/map.npz, the page has the others"


def test_a_folder_of_none_is_refused_with_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "readme.txt").write_text("none")
    (tmp_path / "more.txt").write_text("none")
    with pytest.raises(DatasetError, match=r"looked for .*7-Scenes"):
        open_among(str(tmp_path), open_one)


def test_a_folder_whose_parts_are_broken_is_refused_as_a_whole(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frames.npz").write_bytes(b"no archive")
    with pytest.raises(DatasetError, match=r"contains several recordings; pass one of: a, b"):
        open_among(str(tmp_path), open_one)


def test_the_only_recording_in_a_folder_is_opened_as_before(tmp_path: Path) -> None:
    write_frames(tmp_path / "only" / "frames.npz", 0, 1)
    source, notes = open_among(str(tmp_path), open_one)
    assert source.among is None
    assert notes[0] == f"the recording is {tmp_path / 'only'}"


def test_files_are_of_one_recording(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = taichi_mrf("live", folder, "--out", out, "--port", "0", "--voxel-size", "0.08")
    assert_refused(done, "holds several recordings, and --out takes the files of one", *NAMES)
    assert not out.exists()
