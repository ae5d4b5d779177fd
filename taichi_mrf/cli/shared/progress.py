"""Progress of a command: a bar on a terminal, elsewhere a line on stderr every few seconds.

Results go to stdout, everything about the work to stderr: `taichi-mrf map ... > result.txt` keeps its
progress on the screen.
"""

import contextlib
import logging
import sys
import time
from types import TracebackType

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from taichi_mrf.cli.options.shared import Verbosity
from taichi_mrf.cli.shared.terminal import Terminal, printable
from taichi_mrf.system import compiling, taichi_environment

LINE_SECONDS = 5.0
"""Time between two lines where there is no terminal."""


def open_terminal(verbosity: Verbosity, stderr: bool = False) -> Terminal:
    """The console that a command prints to. --quiet prints nothing, --verbose also logs to stderr. ``stderr``
    leaves stdout to --json."""
    terminal = Terminal(stderr=stderr, quiet=verbosity.quiet)
    log = logging.getLogger("taichi_mrf")
    for handler in [each for each in log.handlers if isinstance(each, _LogLines)]:
        log.removeHandler(handler)
    if verbosity.verbose:
        log.addHandler(_LogLines(Terminal(stderr=True)))
    log.setLevel(logging.INFO if verbosity.verbose else logging.NOTSET)
    return terminal


def tell_first_run(verbosity: Verbosity) -> None:
    """Say to a person at a terminal, before Taichi is started, that kernels have to be compiled, if there are
    none yet."""
    note = taichi_environment.first_run_note()
    if note is not None and sys.stderr.isatty():
        Terminal(stderr=True, quiet=verbosity.quiet).print_line(note)


class _LogLines(logging.Handler):
    """The library's log as lines on the terminal."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__()
        self._terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        self._terminal.print_line(record.getMessage())


class ProgressBar:
    """Shows one stage at a time; used as a context, which removes the bar at its end.

    On a terminal it is a bar. Elsewhere it is a line on stderr every few seconds, with --verbose a line for
    every step, with --quiet nothing.
    """

    def __init__(self, terminal: Terminal, verbosity: Verbosity | None = None) -> None:
        verbosity = verbosity or Verbosity()
        self._line_terminal = Terminal(stderr=True, quiet=terminal.quiet)
        self._verbose = verbosity.verbose
        self._lines = not terminal.is_terminal or verbosity.verbose
        self._progress = Progress(
            TextColumn("{task.description:9}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            TimeRemainingColumn(),
            console=terminal,
            transient=True,
            disable=self._lines or terminal.quiet,
        )
        self._task: TaskID | None = None
        self._stage, self._keyframes, self._steps = "", 0, ""
        self._begin = self._last_line = time.monotonic()
        self._compiling = compiling.Waiting(self._tell_compiling)
        self._watching = contextlib.ExitStack()

    def advance(self, stage: str, done: int, total: int | None, keyframes: int = 0, note: str = "") -> None:
        """``done`` of ``total`` steps of a stage are done; a new stage takes the place of the one before.

        ``keyframes`` more have passed, of which the rate is shown, unless there is a ``note`` to show.
        """
        now = time.monotonic()
        if stage != self._stage or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._stage, self._keyframes, self._begin = stage, 0, now
            self._task = self._progress.add_task(printable(stage), total=total, note="")
        self._keyframes += keyframes
        self._compiling.step()
        self._steps = f"{stage} {done}" + ("" if total is None else f" of {total}")
        note = note or self._rate(now)
        if not self._lines:
            self._progress.update(self._task, completed=done, total=total, note=printable(note))
        else:
            self._print(note, now)

    def _print(self, note: str, now: float) -> None:
        """Print how far the stage is, if it is time for a line."""
        if self._verbose or now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            with contextlib.suppress(OSError):  # the reader of the lines is gone: the run continues
                self._line_terminal.print_line(self._steps + (f", {note}" if note else ""))

    def _tell_compiling(self, note: str) -> None:
        if self._lines:
            self._print(note, time.monotonic())
        elif self._task is not None:
            self._progress.update(self._task, note=note, refresh=True)

    def _rate(self, now: float) -> str:
        seconds = now - self._begin
        return f"{self._keyframes / seconds:.1f} keyframes/s" if self._keyframes and seconds else ""

    def __enter__(self) -> "ProgressBar":
        self._progress.start()
        self._watching.enter_context(compiling.told(self._compiling))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._watching.close()
        self._progress.stop()
