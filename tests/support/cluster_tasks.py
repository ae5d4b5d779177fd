"""Functions that tests hand to task runners; the processes of the tasks import them by name."""

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import NoReturn

from taichi_mrf.errors import DatasetError

LONG = 300.0
"""Seconds that no test waits for."""


def double(number: int) -> int:
    """A task that always goes well, whatever it prints."""
    print("what a task prints is no answer")
    return 2 * number


def where(number: int) -> tuple[int, bool, dict[str, str]]:
    """Its process, whether it runs on the main thread, and its environment."""
    return os.getpid(), threading.current_thread() is threading.main_thread(), dict(os.environ)


def refuse(task: tuple[Path, int]) -> int:
    """Number 1 is bad input; all others take long, and leave a file if nobody stops them."""
    folder, number = task
    if number == 1:
        raise DatasetError(f"number {number} is bad")
    time.sleep(LONG)
    (folder / "not stopped").touch()
    return number


class PickyError(Exception):
    """An exception that cannot be unpickled, as many libraries have them."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def picky(number: int) -> NoReturn:
    """Fails with a foreign exception."""
    raise PickyError(number, number)


def die_once(task: tuple[Path, int]) -> int:
    """Number 1 is killed at its first attempt; every attempt leaves a line."""
    folder, number = task
    with (folder / f"{number}.txt").open("a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
    if number == 1 and len((folder / "1.txt").read_text(encoding="utf-8").splitlines()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return 10 * number


def always_die(number: int) -> int:
    """Number 1 is killed each time."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return 10 * number


def save_when_stopped(task: tuple[Path, int]) -> str:
    """Says that it runs, and gives an answer of its own if it is asked to stop. Number 0 ends at once."""
    folder, number = task
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    (folder / f"{number}.pid").write_text(str(os.getpid()), encoding="utf-8")
    if number and not stopped.wait(LONG):
        sys.exit("nobody has stopped this task")
    return "whole" if not number else "saved"
