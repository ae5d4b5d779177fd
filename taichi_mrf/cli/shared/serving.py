"""Common parts of commands with a page: who can reach it, its address, and the priority of processes."""

import os
import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # options are parsed with this file, and need no NumPy
    from taichi_mrf.viewer.messages import Listening

LOOPBACK = ("127.0.0.1", "::1", "localhost")

NICENESS = 10
"""Reduction of the priority of mapping below that of the page."""

PrintLine = Callable[[str], None]


def warn_of_host(host: str, port: int, what_they_can: str, print_line: PrintLine) -> None:
    """Warn if ``host`` serves the page to other machines."""
    if host in LOOPBACK:
        return
    here = port or "PORT"  # 0 is any
    print_line(
        f"Warning: the page at --host {host} has no password: anyone who can reach this machine can "
        f"{what_they_can}. It is safer to omit --host and to tunnel from where you watch: "
        f"ssh -L {here}:127.0.0.1:{here} USER@THIS-MACHINE"
    )


def let_the_page_go_first() -> None:
    """Lower this process's priority: once the page has been started, so that it keeps its own, and before
    Taichi starts threads, which inherit it."""
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICENESS)


def print_address(
    where: "Listening", what: str, wanted_port: int, open_browser: bool, print_line: PrintLine
) -> None:
    """Print the page's address, and before it that another port was taken than the requested one (0: any);
    open a browser if asked."""
    if wanted_port not in (0, where.port):
        print_line(f"Port {wanted_port} is busy, so the page took {where.port}.")
    print_line(f"{what} is at {where.url}  (Ctrl-C ends it)")
    if open_browser:
        webbrowser.open(where.url)
