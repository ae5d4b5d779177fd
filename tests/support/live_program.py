"""``taichi-mrf live`` or ``tune`` as a person runs it: a process with a page, its words, what is left."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

DEADLINE_S = 120.0
"""For what takes seconds, on a machine that is busy with something else."""

PROGRAM = ("-m", "taichi_mrf")


def with_shortest_life(seconds: float) -> tuple[str, str]:
    """The program, which starts a viewer again that has ended if it has lived for so long."""
    program = (
        f"import sys; from taichi_mrf.cli import map_page; map_page.SHORTEST_LIFE_SECONDS = {seconds!r}; "
        "from taichi_mrf.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    return "-c", program


_ADDRESS = re.compile(r"The (?:map|page) is at (http://\S+)")


class LiveProgram:
    """The running program; use it as a context. ``address`` is where its page is, ``said`` what it has
    printed so far, line by line."""

    def __init__(
        self,
        *arguments: str | Path,
        command: str = "live",
        port: int | None = 0,
        start: tuple[str, str] = PROGRAM,
    ) -> None:
        """Start it, on any free port unless told, and wait for its address; None is for one without a page.
        ``start`` are the interpreter's arguments."""
        flags = [] if port is None else ["--port", str(port)]
        self.said: list[str] = []
        # A session of its own, so that whatever it starts can be found by the number of its group.
        self._process = subprocess.Popen(
            [sys.executable, *start, command, *map(str, arguments), *flags],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self.address = "" if port is None else str(wait_for(self._find_address, "the page's address"))
        except BaseException:
            self.kill_group()
            raise

    @property
    def pid(self) -> int:
        """Of the process that maps, which is also the number of the group."""
        return self._process.pid

    @property
    def port(self) -> int:
        """Address of the page."""
        return int(self.address.rpartition(":")[2])

    def group(self) -> dict[int, str]:
        """The processes of the group that are alive: number -> command line."""
        alive = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                status = (folder / "stat").read_text().rpartition(")")[2].split()
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:  # it has just ended
                continue
            if int(status[2]) == self.pid and status[0] != "Z":
                alive[int(folder.name)] = command.strip()
        return alive

    def end(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, float]:
        """Send a signal to the process that maps, and wait for it; returns its exit status and how many
        seconds it took."""
        begin = time.monotonic()
        os.kill(self.pid, number)
        status = self.wait()
        return status, time.monotonic() - begin

    def wait(self) -> int:
        """Wait until the process that maps has ended; returns its exit status."""
        status = self._process.wait(timeout=DEADLINE_S)
        self._reader.join(timeout=DEADLINE_S)
        return status

    def wait_until_nothing_is_left(self) -> None:
        """Wait until no process of the group is alive."""
        wait_for(lambda: not self.group(), lambda: f"the end of {self.group()}")

    def kill_group(self) -> None:
        """End all at once, in whatever state they are."""
        if self.group():
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()

    def __enter__(self) -> "LiveProgram":
        return self

    def __exit__(self, *exception: object) -> None:
        self.kill_group()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said.append(line.rstrip("\n"))

    def _find_address(self) -> str | None:
        if self._process.poll() is not None:
            self._reader.join(timeout=DEADLINE_S)
            raise AssertionError(f"the program has ended: {self.said}")
        return next((found[1] for line in self.said if (found := _ADDRESS.search(line))), None)


def wait_for(
    condition: Callable[[], object],
    what: str | Callable[[], str],
    pause: Callable[[float], None] = time.sleep,
) -> object:
    """Look again and again until ``condition`` gives something true, and return that.

    Raises AssertionError, which names ``what`` was waited for, after DEADLINE_S. ``pause`` waits for some
    seconds.
    """
    deadline = time.monotonic() + DEADLINE_S
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > deadline:
            raise AssertionError(f"waited in vain for {what if isinstance(what, str) else what()}")
        pause(0.05)
