"""The interface of a task runner, and what the runners share."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

from taichi_mrf.errors import ClusterError

T = TypeVar("T")
R = TypeVar("R")

ATTEMPTS = 3
"""Number of starts of a task, at most, when its processes die."""

_LONGEST_NAME = 60


def nothing(index: int, result: Any) -> None:
    """The default for ``done``: ignore the result."""


class TaskRunner(Protocol):
    """Runs tasks that do not depend on each other."""

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """``function(task)`` for each task, each in a process of its own; results in the order of the tasks.

        ``done`` is called in the caller's thread, once for each task, with its index and its result as soon
        as the task has finished. ``function`` can be imported by name, tasks and results can be pickled.
        The function runs on its process' main thread; what it prints goes to stderr.

        A task whose process dies (killed, out of memory, crashed) is restarted in another, up to ATTEMPTS
        starts; it may therefore find files of an earlier attempt. If a task is lost nevertheless, the
        others finish; then ClusterError is raised, which names the lost ones.

        An exception of the function itself, which a restart would only repeat, stops the other tasks and is
        raised. So do exceptions of ``done``, and Ctrl-C: the running tasks are asked to stop (SIGTERM, on
        which a function may save its work), their last results are passed to ``done``, then
        KeyboardInterrupt is raised again. A second Ctrl-C kills them.
        """


class TaskLostError(ClusterError):
    """All processes that were started for a task have died."""

    @classmethod
    def after(cls, death: Exception) -> "TaskLostError":
        """The error after ATTEMPTS deaths; ``death`` was the last."""
        return cls(f"{death}, {ATTEMPTS} times")


def gather(
    tasks: Sequence[T], finished: Iterable[tuple[int, Callable[[], R]]], done: Callable[[int, R], None]
) -> list[R]:
    """The results in the order of the tasks, from (index, answer) in the order in which tasks finish.

    ``answer()`` returns the result or raises. Its exceptions are raised, TaskLostError only after the other
    tasks, as ClusterError.
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
