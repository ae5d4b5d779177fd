"""``taichi-mrf tune`` as a person runs it: a process with a page."""

import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

from live_program import DEADLINE_S, wait_for

_ADDRESS = re.compile(r"The page is at (http://\S+)")


class TuneProgram:
    """The running program; use it as a context. ``said`` is what it has printed so far, line by line."""

    def __init__(self, *arguments: str | Path) -> None:
        command = [sys.executable, "-m", "taichi_mrf", "tune", *map(str, arguments)]
        self.said: list[str] = []
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def address(self) -> str:
        """Wait for where the page is."""
        return str(wait_for(lambda: self.match(_ADDRESS), lambda: f"the page's address in {self.said}"))

    def match(self, pattern: re.Pattern[str]) -> str | None:
        """The first group of a pattern, in the first line that has it; None if there is none yet."""
        if self._process.poll() is not None:
            self._reader.join(timeout=DEADLINE_S)
        return next((found[1] for line in list(self.said) if (found := pattern.search(line))), None)

    def end(self) -> int:
        """Ctrl-C, and the exit status."""
        self._process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self) -> int:
        """Wait for the end; returns the exit status."""
        status = self._process.wait(timeout=DEADLINE_S)
        self._reader.join(timeout=DEADLINE_S)
        return status

    def __enter__(self) -> "TuneProgram":
        return self

    def __exit__(self, *exception: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said.append(line.rstrip("\n"))
