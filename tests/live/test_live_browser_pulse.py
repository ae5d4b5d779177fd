"""A page without a server or a mapping process behind it, in a real Chromium: it says so, and comes back."""

import os
import signal
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import pytest
from browser import LivePage, chromium, missing
from live_program import LiveProgram, wait_for

from taichi_mrf.viewer.transport import server as viewer_server
from taichi_mrf.viewer.transport.server import start_server
from taichi_mrf.viewer.transport.viser_internals import connections

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ARGUMENTS = ("synthetic:room?frames=6&width=96&height=72", "--voxel-size", "0.1", "--runtime.arch", "cpu")

DISCONNECTED = "disconnected: reload"
SILENT = "the mapper does not answer"
DONE = "up to date"

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    with chromium() as running:
        yield running


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
    """Whether the page has lost the mark that a test has set in it."""
    from playwright.sync_api import Error

    try:
        return not page.page.evaluate("() => window.isTheSame")
    except Error:  # it reloads now
        return False


def test_a_page_says_what_does_not_answer_and_comes_back(browser: "Browser") -> None:
    with LiveProgram(*ARGUMENTS) as program, LivePage(browser, program.address) as page:
        page.until_settled()
        page.page.evaluate("() => { window.isTheSame = true; }")
        (viewer,) = (pid for pid, command in program.group().items() if "spawn_main" in command)
        for stopped, words in ((viewer, DISCONNECTED), (program.pid, SILENT)):
            until_it_says(page, DONE)
            os.kill(stopped, signal.SIGSTOP)
            until_it_says(page, words)
            page.screenshot(words.replace(" ", "_").replace(":", ""))
            os.kill(stopped, signal.SIGCONT)
        until_it_says(page, DONE)
        assert page.page.evaluate("() => window.isTheSame")
        os.kill(program.pid, signal.SIGKILL)
        until_it_says(page, DISCONNECTED)
        program.wait_until_nothing_is_left()
        with LiveProgram(*ARGUMENTS, port=program.port):
            until_it_says(page, DONE)
            page.until_settled()


def test_a_page_without_the_focus_connects_again(browser: "Browser") -> None:
    with LiveProgram(*ARGUMENTS) as program, LivePage(browser, program.address) as page:
        page.page.evaluate("() => { Document.prototype.hasFocus = () => false; }")
        page.until_settled()
        program.end()
        until_it_says(page, DISCONNECTED)
        with LiveProgram(*ARGUMENTS, port=program.port):
            until_it_says(page, DONE)


def test_a_page_whose_socket_does_not_come_back_reloads(
    browser: "Browser", monkeypatch: pytest.MonkeyPatch
) -> None:
    server = start_server("127.0.0.1", 0, "Full")
    try:
        with LivePage(browser, f"http://127.0.0.1:{server.get_port()}") as page:
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
