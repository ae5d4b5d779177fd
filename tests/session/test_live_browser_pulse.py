"""A page without a server or a mapping process behind it, in a real Chromium: it says so, and comes back.

The tests of one program follow each other; the last one ends it.
"""

import os
import signal
from collections.abc import Iterator
from functools import partial

import pytest
from browser import Browser, LivePage, missing
from live_program import LiveProgram, wait_for, with_shortest_life

from taichi_mrf.viewer.transport import server as viewer_server
from taichi_mrf.viewer.transport.server import start_server
from taichi_mrf.viewer.transport.viser_internals import connections

ARGUMENTS = ("synthetic:room?frames=6&width=96&height=72", "--voxel-size", "0.1", "--runtime.arch", "cpu")

DISCONNECTED = "disconnected: reload"
SILENT = "the mapper does not answer"
DONE = "up to date"

NO_SERVER = (
    "WebSocket connection to",
    "Failed to open WebSocket",
    "Failed to load resource: net::ERR",
    "Failed to load resource: the server responded with a status of 503",
)
"""Beginnings of what a browser reports while there is no server, or one that is starting, as it must."""

WITHOUT_FOCUS = "Document.prototype.hasFocus = () => false;"
HURRIED = "const later = setTimeout; setTimeout = (call, ms, ...given) => later(call, ms / 5, ...given);"
"""Scripts that run before those of the page: one lets it wait for a fifth of the time."""

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def program() -> Iterator[LiveProgram]:
    """One that starts each viewer again, however young. Its port is none of those that the system gives away,
    or another program could be given it while nobody listens."""
    port = 20000 + os.getpid() % 10000
    with LiveProgram(*ARGUMENTS, port=port, start=with_shortest_life(0.0)) as running:
        yield running


@pytest.fixture(scope="module")
def page(program: LiveProgram, browser: Browser) -> Iterator[LivePage]:
    """A page that never has the focus."""
    with LivePage(browser, program.address, script=WITHOUT_FOCUS) as opened:
        opened.until_settled()
        opened.page.evaluate("() => { window.isTheSame = true; }")
        yield opened


def until_it_says(page: LivePage, *words: str) -> None:
    """Wait until the page says these of the three, and none of the others."""
    from playwright.sync_api import Error

    others = {DISCONNECTED, SILENT, DONE} - set(words)

    def says_so() -> bool:
        try:
            text = page.text()
        except Error:  # the page reloads
            return False
        return all(each in text for each in words) and not any(each in text for each in others)

    wait_for(says_so, f"{words} alone", page.pause)


def has_reloaded(page: LivePage) -> bool:
    """True if the page has lost the mark that a test has set in it."""
    from playwright.sync_api import Error

    try:
        return not page.page.evaluate("() => window.isTheSame")
    except Error:  # it reloads now
        return False


def until_reconnected(page: LivePage, list_before: str | None, voxels: int) -> None:
    """Wait until the same page shows the whole map of another viewer, and see that its slider is answered."""
    page.until(lambda seen: list_id(page) != list_before, "another viewer")
    until_it_says(page, DONE)
    assert not has_reloaded(page)
    assert page.until_settled().voxels == voxels
    page.nudge("Threshold", "ArrowRight")
    page.until(lambda seen: seen.agrees and seen.voxels < voxels, "fewer voxels")
    page.nudge("Threshold", "ArrowLeft")
    page.until(lambda seen: seen.agrees and seen.voxels == voxels, "all voxels")
    assert all(problem.startswith(NO_SERVER) for problem in page.problems), page.problems


def list_id(page: LivePage) -> str | None:
    """Of a dropdown; another viewer gives it another one."""
    return page.input("Draw as").get_attribute("id")


def viewer_of(program: LiveProgram) -> int:
    """The process of the page."""
    (viewer,) = (pid for pid, command in program.group().items() if "spawn_main" in command)
    return viewer


def test_a_page_says_what_does_not_answer(program: LiveProgram, page: LivePage) -> None:
    for stopped, words in ((viewer_of(program), DISCONNECTED), (program.pid, SILENT)):
        until_it_says(page, DONE)
        os.kill(stopped, signal.SIGSTOP)
        until_it_says(page, words)
        line, head = page.page.locator("#cut-off"), page.page.get_by_text("taichi_mrf: ")
        ends = line.bounding_box(), head.bounding_box()
        assert ends[0]["x"] + ends[0]["width"] <= ends[1]["x"], "beside the panel, not over it"
        page.screenshot(words.replace(" ", "_").replace(":", ""))
        os.kill(stopped, signal.SIGCONT)
    until_it_says(page, DONE)
    assert not has_reloaded(page)


def test_a_viewer_that_dies_is_started_again(program: LiveProgram, page: LivePage) -> None:
    voxels, looks, viewer = page.until_settled().voxels, list_id(page), viewer_of(program)
    os.kill(viewer, signal.SIGKILL)
    wait_for(lambda: viewer not in program.group(), "its end")
    until_reconnected(page, looks, voxels)


def test_a_server_that_is_killed_and_restarted_is_found_again(program: LiveProgram, page: LivePage) -> None:
    voxels, looks = page.until_settled().voxels, list_id(page)
    os.kill(program.pid, signal.SIGKILL)
    assert program.wait() == -signal.SIGKILL
    until_it_says(page, DISCONNECTED)
    program.wait_until_nothing_is_left()
    with LiveProgram(*ARGUMENTS, port=program.port) as again:
        assert again.port == program.port
        until_reconnected(page, looks, voxels)
        page.screenshot("server_restarted")


def test_a_page_whose_socket_does_not_come_back_reloads(
    browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = start_server("127.0.0.1", 0, "Full")
    try:
        with LivePage(browser, f"http://127.0.0.1:{server.get_port()}", script=HURRIED) as page:
            wait_for(server.get_clients, "the page", page.pause)
            monkeypatch.setattr(viewer_server, "MOST_CLIENTS", 0)
            page.page.evaluate("() => { window.isTheSame = true; }")
            for connection in connections(server).values():
                connection.transport.abort()
            until_it_says(page, DISCONNECTED)
            wait_for(partial(has_reloaded, page), "the page to reload", page.pause)
            monkeypatch.undo()
            until_it_says(page)
    finally:
        server.stop()
