"""What a task runner promises, and the simplest one."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

from taichi_mrf.errors import ClusterError

T = TypeVar("T")
R = TypeVar("R")

ATTEMPTS = 3
"""How often a task is begun, at most, when the processes that take it die."""

_LONGEST_NAME = 60


def nothing(index: int, result: Any) -> None:
    """What is done with a result as soon as it is there, if nobody says."""


class TaskRunner(Protocol):
    """Carries out tasks that do not depend on each other."""

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """``function(task)`` for each task, each in a process of its own; results in the order of the tasks.

        ``done`` is called, in the caller's thread, with a task's index and result as soon as it is there, and
        once for each task. ``function`` can be imported by name, tasks and results can be pickled. The
        function runs on its process' main thread; what it prints goes to stderr.

        A task whose process dies (killed, out of memory, crashed) begins again in another, ATTEMPTS times at
        most; a task may therefore find what an earlier attempt has written. A task that is lost all the same
        lets the others finish; then ClusterError is raised, which names the lost ones.

        An exception of the function itself, which another attempt would only repeat, stops the other tasks
        and is raised. So does whatever ``done`` raises, and Ctrl-C: the tasks under way are asked to stop
        (SIGTERM, which a function may use to save what it has), the results that they still give are handed
        to ``done``, then KeyboardInterrupt is raised again. A second Ctrl-C kills them.
        """


class InProcess:
    """One task after the other in this process: for tests, and to step through with a debugger."""

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """See TaskRunner; nothing survives the death of this process."""
        results = []
        for index, task in enumerate(tasks):
            results.append(function(task))
            done(index, results[-1])
        return results


class TaskLostError(ClusterError):
    """Every process that took a task has died."""

    @classmethod
    def after(cls, death: Exception) -> "TaskLostError":
        """As often as a task is begun; ``death`` was the last."""
        return cls(f"{death}, {ATTEMPTS} times")


def gather(
    tasks: Sequence[T], finished: Iterable[tuple[int, Callable[[], R]]], done: Callable[[int, R], None]
) -> list[R]:
    """The results in the order of the tasks, from (index, answer) in the order in which they come.

    ``answer()`` gives the result or raises. Raises what it raises, but TaskLostError only after the others as
    ClusterError.
    """
    results: dict[int, R] = {}
    lost: dict[int, str] = {}
    for index, answer in finished:
        try:
            results[index] = answer()
        except TaskLostError as error:
            lost[index] = str(error)
        else:
            done(index, results[index])
    if lost:
        raise ClusterError(_what_is_lost(tasks, lost), lost)
    return [results[index] for index in range(len(tasks))]


def _what_is_lost(tasks: Sequence[T], lost: dict[int, str]) -> str:
    first = min(lost)
    name = str(tasks[first])
    name = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 3]}..."
    others = f"; {len(lost) - 1} more tasks are lost" if len(lost) > 1 else ""
    return f"task {first + 1} of {len(tasks)}, {name}: {lost[first]}{others}"
