"""The console program, in this process or in one of its own, and what its tests share."""

import io
import json
import logging
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

from new_interpreter import python

from taichi_mrf.cli.main import main
from taichi_mrf.cli.parser import parse
from taichi_mrf.cli.shared import progress
from taichi_mrf.system import runtime

Done = subprocess.CompletedProcess[str]

ROOM = "synthetic:room?frames=12&width=160&height=120"
COARSE = ("--voxel-size", "0.1", "--runtime.arch", "cpu")
FAST = (*COARSE, "--no-pictures")


def taichi_mrf(
    *arguments: str | Path, options: tuple[str, ...] = (), before: Callable[[], None] | None = None
) -> Done:
    """Run the program and return its exit status and what it printed.

    It runs in this process, whose kernels are compiled, unless the interpreter's ``options`` or a call
    ``before`` the program starts need a new one. A slow machine adds no lines of progress to stderr.
    """
    if options or before is not None:
        return as_process(*arguments, options=options, before=before)
    runtime.init("cpu")
    out, err = io.StringIO(), io.StringIO()
    with ExitStack() as stack:
        stack.enter_context(patch.object(progress, "LINE_SECONDS", float("inf")))
        stack.enter_context(redirect_stdout(out))
        stack.enter_context(redirect_stderr(err))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = _show_warning
        stack.enter_context(_own_log())
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 1
    return subprocess.CompletedProcess(list(arguments), status, out.getvalue(), err.getvalue())


@contextmanager
def signalled(number: int, at: str, *, step: int = 1, times: int = 1) -> Iterator[None]:
    """The program in this process gets a signal, once or more often, when it says that so many steps of the
    stage ``at`` are done."""
    advance, left = progress.ProgressBar.advance, [number] * times

    def advance_and_signal(bar: progress.ProgressBar, stage: str, done: int, *rest: Any, **more: Any) -> None:
        advance(bar, stage, done, *rest, **more)
        while left and stage == at and done >= step:
            signal.raise_signal(left.pop())

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a run in the background ignores it
    try:
        with patch.object(progress.ProgressBar, "advance", advance_and_signal):
            yield
        assert not left, f"the program did not come to step {step} of {at}"
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _own_log() -> Iterator[None]:
    """Changes that --verbose makes to the library's log end with the program, as they do in a process."""
    log = logging.getLogger("taichi_mrf")
    level, handlers = log.level, list(log.handlers)
    try:
        yield
    finally:
        log.setLevel(level)
        log.handlers[:] = handlers


def as_process(
    *arguments: str | Path, options: tuple[str, ...] = (), before: Callable[[], None] | None = None
) -> Done:
    """Run the program as a process of its own; ``options`` are the interpreter's."""
    return python(*options, "-m", "taichi_mrf", *arguments, before=before)


def complaints(stderr: str) -> str:
    """Lines that a process printed on stderr, without those of its progress."""
    lines = stderr.splitlines(keepends=True)
    return "".join(line for line in lines if not re.match(r"\w+ \d+( of \d+)?(, |$)", line))


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any
) -> None:
    """As a process shows a warning; pytest puts its own function in place of Python's."""
    sys.stderr.write(warnings.formatwarning(message, category, filename, lineno))


def mapped(*arguments: str | Path) -> str:
    """Run ``map``, which must succeed without complaints; returns what it printed."""
    done = taichi_mrf("map", *arguments)
    assert done.returncode == 0, done.stderr
    assert complaints(done.stderr) == ""
    return done.stdout


def report_of(out: Path) -> dict:
    return json.loads((out / "report.json").read_text(encoding="utf-8"))


def assert_refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit status 2, and one line on stderr with all these words."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr
    assert done.stdout == ""


def carry_out(*arguments: object) -> int:
    """Parse the arguments and run the command in this process; returns the exit status. Its exceptions reach
    the test."""
    command, options = parse([str(argument) for argument in arguments])
    return command.run(options)
