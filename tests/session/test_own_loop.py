"""A page beside the caller's own loop shows what the loop does to its map, and edits that map."""

import asyncio
import signal
import subprocess
import sys
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import psutil
import pytest
import small_room
from live_program import DEADLINE_S
from live_scene import FakeLink, assert_shown_is, shown

import taichi_mrf as tm
from taichi_mrf.config.arguments import ArgumentTypeError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.session.own_loop import LivePage
from taichi_mrf.viewer.messages import Notice, Quit, Request, Select, Status, Switch, Update


def page_of(m: MRFMap) -> tuple[LivePage, FakeLink]:
    link = FakeLink()
    return LivePage(m, link=link), link


def names(link: FakeLink) -> list[str]:
    return [each.name for each in shown(link.sent).keyframes.values()]


def add(m: MRFMap, index: int) -> int:
    id = small_room.add(m, small_room.frames()[index])
    m.renew([id])
    return id


@pytest.mark.usefixtures("one_backend")
def test_the_page_shows_what_the_loop_does() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    page, link = page_of(m)
    for index in range(2):
        add(m, index)
        assert page.update()
        assert_shown_is(page._session, link, decided=False)
        assert names(link) == [frame.name for frame in small_room.frames()[: index + 1]]
    T = small_room.frames()[1].T_world_camera.copy()
    T[:3, 3] += 0.2
    m.move_keyframe(1, T)
    m.renew()
    page.update()
    assert_shown_is(page._session, link, decided=False)
    np.testing.assert_array_equal(shown(link.sent).keyframes[1].T_world_camera, T)
    m.remove_keyframe(0)
    m.renew()
    page.update()
    assert_shown_is(page._session, link, decided=False)
    assert names(link) == [small_room.frames()[1].name]
    m.freeze_keyframe(1)
    page.update()
    assert [each.state for each in shown(link.sent).keyframes.values()] == ["frozen"]
    assert link.of_type(Notice) == []


@pytest.mark.usefixtures("one_backend")
def test_the_page_edits_the_map_of_the_loop() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    page, link = page_of(m)
    for index in range(2):
        add(m, index)
    page.update()
    link.ask(Switch(0, False))
    page.update()
    assert list(m.keyframes) == [1]
    assert_shown_is(page._session, link, decided=False)
    page.update()  # nothing was done: there is time for more
    assert_shown_is(page._session, link)
    link.ask(Switch(0, True))
    page.update()
    assert {each.name for each in m.keyframes.values()} == set(names(link))
    assert link.of_type(Status)[-1].activity == "the map as of the last update"
    assert page.selected.shape == (0, 3)
    there_m = np.array([[0.5, 0.5, 0.5]])
    link.ask(Select(there_m))
    page.update()
    np.testing.assert_array_equal(page.selected, there_m)
    link.ask(Quit())
    assert not page.update()
    assert not page.update()


@pytest.mark.usefixtures("one_backend")
def test_a_map_that_is_shown_is_not_changed_before_somebody_edits_it() -> None:
    m = MRFMap(small_room.VOXEL_SIZE)
    for index in range(2):
        add(m, index)
    before = m.occupancy(small_room.probes())

    def at_rest(update: Update) -> list[Request]:
        return [Quit()] if isinstance(update, Status) and "up to date" in update.activity else []

    link = FakeLink(at_rest)
    LivePage(m, link=link).serve()
    np.testing.assert_array_equal(m.occupancy(small_room.probes()), before)
    assert link.errors() == []


def test_what_is_no_map_is_refused() -> None:
    with pytest.raises(ArgumentTypeError, match=r"m must be a map that takes keyframes, .* not 3"):
        tm.live(3)  # type: ignore[arg-type]


@pytest.mark.usefixtures("one_backend")
def test_a_notebook_shows_the_page_below_the_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    link = FakeLink()
    page = tm.show(MRFMap(small_room.VOXEL_SIZE), link=link)
    page.url = "http://127.0.0.1:1"

    async def cell() -> str:
        html = page._repr_html_()
        link.ask(Quit())
        await asyncio.sleep(0.05)
        return html

    assert '<iframe src="http://127.0.0.1:1"' in asyncio.run(cell())
    assert page._session.state.ended


SCRIPT = """
import numpy as np, taichi_mrf as tm
tm.init("cpu")
m, camera = tm.MRFMap(0.1), tm.PinholeCamera(32, 24, 30, 30, 15.5, 11.5)
with tm.live(m, port=0) as page:
    for i in range(3):
        m.renew([m.add_keyframe(np.full((24, 32), 2, np.float32), np.eye(4), camera)])
        print(page.update(), page.url, flush=True)
        input()
tm.show(m, port=0, browser=False)
print("ended", flush=True)
"""


@pytest.mark.usefixtures("own_interrupts")
def test_a_script_without_a_guard_has_a_page(tmp_path: Path) -> None:
    """Its main module is not run again by the page's process, and Ctrl-C ends what shows the map."""
    path = tmp_path / "loop.py"
    path.write_text(SCRIPT)
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, path], text=True, **pipes) as run, ExitStack() as stack:
        stack.callback(run.kill)  # a failure would wait for its end
        words = run.stdout.readline().split()
        assert words[0] == "True"
        assert urllib.request.urlopen(words[1]).status == 200
        print("\n\n", file=run.stdin, flush=True)  # it waits after each keyframe
        assert [run.stdout.readline().split() for _ in range(2)] == [words, words]
        warning = run.stderr.readline()
        assert urllib.request.urlopen(warning.split()[-1]).status == 200
        run.send_signal(signal.SIGINT)
        rest, errors = run.communicate()
    assert (rest, run.returncode) == ("ended\n", 0), errors


@pytest.mark.parametrize("end", ["", "raise SystemExit(0)", "del page", "raise ValueError"])
def test_a_script_that_leaves_its_page_open_ends(tmp_path: Path, end: str) -> None:
    """The page's process ignores SIGTERM, and ends with the script all the same."""
    path = tmp_path / "open.py"
    path.write_text(
        f"import multiprocessing, taichi_mrf as tm\ntm.init('cpu')\npage = tm.live(tm.MRFMap(0.1), port=0)\n"
        f"print(*[each.pid for each in multiprocessing.active_children()], flush=True)\n{end}\n"
    )
    pipes: dict[str, Any] = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([sys.executable, path], text=True, **pipes) as run:
        pids = [int(word) for word in run.stdout.readline().split()]
        try:
            errors = run.communicate(timeout=DEADLINE_S)[1]
        finally:
            pages = [psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)]
            for process in pages:
                process.kill()
    assert run.returncode == (end == "raise ValueError"), errors
    assert pids
    assert not pages
