"""Tasks on this machine, several at a time."""

import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any

from taichi_mrf.cluster.child import pickled_task, result_of
from taichi_mrf.cluster.processes import ProcessDiedError, TaskProcesses, environment_of
from taichi_mrf.cluster.runner import ATTEMPTS, R, T, TaskLostError, gather, nothing
from taichi_mrf.errors import ConfigError

_GLANCE = 0.5
"""Seconds between checks for Ctrl-C, which on Windows does not end a wait."""


class LocalProcesses:
    """Up to ``jobs`` tasks at a time, each in a process that is started for it.

    The cores are divided among the jobs, and each job has one GPU where there are several.
    """

    def __init__(self, jobs: int = 1) -> None:
        if jobs < 1:
            raise ConfigError(f"jobs must be at least 1, not {jobs}")
        self.jobs = jobs

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """See TaskRunner."""
        processes = TaskProcesses()
        jobs = max(1, min(self.jobs, len(tasks)))
        free: queue.SimpleQueue[int] = queue.SimpleQueue()
        for worker in range(jobs):
            free.put(worker)

        def answer(task: T) -> bytes:
            worker = free.get()
            try:
                payload = pickled_task(function, task)
                return _persistent_answer(processes, payload, environment_of(worker, jobs))
            finally:
                free.put(worker)

        threads = ThreadPoolExecutor(jobs)
        futures: dict[Future[bytes], int] = {}
        waiting: set[Future[bytes]] = set()
        try:
            for index, task in enumerate(tasks):
                futures[threads.submit(answer, task)] = index
            waiting.update(futures)
            return gather(tasks, _as_they_finish(futures, waiting), done)
        except BaseException:
            processes.stop()
            _take_last(_as_they_finish(futures, waiting), done)
            raise
        finally:
            processes.kill()
            threads.shutdown()


def _persistent_answer(processes: TaskProcesses, payload: bytes, environment: dict[str, str]) -> bytes:
    """The answer of the first process that does not die. Raises TaskLostError if all die."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return processes.answer(payload, environment)
        except ProcessDiedError as death:
            if attempt == ATTEMPTS:
                raise TaskLostError.after(death) from death
    raise AssertionError


def _take_last(finished: Iterator[tuple[int, Callable[[], R]]], done: Callable[[int, R], None]) -> None:
    """Hand over the results of tasks that were asked to stop."""
    for index, answer in finished:
        try:
            result = answer()
        except Exception:  # only the first exception is reported
            continue
        done(index, result)


def _as_they_finish(
    futures: "dict[Future[bytes], int]", waiting: "set[Future[bytes]]"
) -> Iterator[tuple[int, Callable[[], R]]]:
    """(index, answer) of each future, taken out of ``waiting`` as it is done."""
    while waiting:
        finished, _ = wait(waiting, timeout=_GLANCE, return_when=FIRST_COMPLETED)
        for future in sorted(finished, key=futures.__getitem__):
            waiting.discard(future)
            yield futures[future], partial(_result, future)


def _result(future: "Future[bytes]") -> Any:
    return result_of(future.result())
