"""Meaning of signals to a run."""

import contextlib
import io
import os
import signal
from collections.abc import Iterator

import pytest
from new_interpreter import output

from taichi_mrf.cli.shared import interrupt
from taichi_mrf.cli.shared.interrupt import StopRequest, interrupt_on_signals, stop_on_signals
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import CutShortError


@pytest.fixture(autouse=True)
def hangups() -> Iterator[None]:
    """SIGHUP has its usual effect, even if the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def received(*numbers: int) -> tuple[StopRequest, list[str]]:
    """The request after these signals, and what the user was printed."""
    printed: list[str] = []
    with stop_on_signals(printed.append) as request:
        for number in numbers:
            os.kill(os.getpid(), number)
    return request, printed


def test_ctrl_c_asks_once_and_leaves_time_to_infer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupt, "INFER_SECONDS", 0.0)
    request, printed = received(signal.SIGINT)
    assert (request.signal, request(), request.out_of_time()) == (signal.SIGINT, True, False)
    assert printed == ["Stopping. What is done so far is saved. Press Ctrl-C again to abort."]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_sighup_leave_seconds(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    request, printed = received(number)
    assert (request.signal, request(), request.out_of_time()) == (number, True, False)
    assert printed == ["Stopping. What is done so far is saved. Press Ctrl-C again to abort."]
    monkeypatch.setattr(interrupt, "INFER_SECONDS", 0.0)
    assert request.out_of_time()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_second_of_them_aborts(number: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        received(number, number)


def test_a_closed_terminal_may_hang_up_twice_and_sigterm_hurries_a_stopping_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    request, printed = received(signal.SIGHUP, signal.SIGHUP)
    assert (request.signal, request.aborted, len(printed)) == (signal.SIGHUP, False, 1)
    monkeypatch.setattr(interrupt, "INFER_SECONDS", 0.0)
    request, printed = received(signal.SIGINT, signal.SIGTERM)
    assert (request.signal, request.out_of_time(), request.aborted) == (signal.SIGINT, True, False)
    assert len(printed) == 1


def test_what_nobody_saves_is_not_called_saved() -> None:
    printed: list[str] = []
    with stop_on_signals(printed.append, keeps=False):
        os.kill(os.getpid(), signal.SIGINT)
    assert printed == ["Stopping. Nothing is saved: there is no --out. Press Ctrl-C again to abort."]


def test_nohup_is_respected() -> None:
    code = (
        "import os, signal\nfrom taichi_mrf.cli.shared.interrupt import stop_on_signals\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "with stop_on_signals(print) as request:\n    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    print(request())"
    )
    assert output(code) == "False"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_part_that_may_be_left_out_is_left_at_once(number: int) -> None:
    reached: list[str] = []
    with stop_on_signals(lambda text: None) as request:
        for _ in range(2):
            with pytest.raises(CutShortError):
                leave_out(request, number, reached)
    assert (request.signal, reached) == (number, ["begin"])


def leave_out(request: StopRequest, number: int, reached: list[str]) -> None:
    with request.cutting_short():
        reached.append("begin")
        os.kill(os.getpid(), number)
        reached.append("end")


class Pipe(io.RawIOBase):
    """A pipe for a program's output, whose reader sends SIGTERM as soon as it has read the first line."""

    def __init__(self) -> None:
        self.read = b""

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:  # type: ignore[override]
        self.read += bytes(data)
        if len(self.read) == len(data):
            os.kill(os.getpid(), signal.SIGTERM)
        return len(data)


def test_a_signal_in_the_middle_of_a_line_stops_the_run_too() -> None:
    pipe = Pipe()
    stream = io.TextIOWrapper(io.BufferedWriter(pipe))
    with contextlib.redirect_stdout(stream):
        terminal = Terminal()
        with pytest.raises(KeyboardInterrupt), interrupt_on_signals(terminal.print_line) as request:
            terminal.print_line("first")
    assert request.signal == signal.SIGTERM
    last = pipe.read.decode().splitlines()[-1]
    assert last == "Stopping. What is done so far is saved. Press Ctrl-C again to abort."
