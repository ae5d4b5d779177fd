"""The choice of the runner for the tasks of a command."""

from collections.abc import Iterator
from contextlib import contextmanager

from taichi_mrf.cluster.dask_tasks import DaskTasks
from taichi_mrf.cluster.local import LocalProcesses
from taichi_mrf.cluster.runner import TaskRunner


@contextmanager
def open_runner(jobs: int = 1, scheduler: str | None = None) -> Iterator[TaskRunner]:
    """``jobs`` processes at a time on this machine, or the workers of a Dask scheduler: ``HOST:PORT``, or
    ``local`` for Dask's own cluster of ``jobs`` workers on this machine.

    Raises ConfigError if ``jobs`` is not positive, TaichiMRFError if Dask is not installed or the
    scheduler does not answer.
    """
    if scheduler is None:
        yield LocalProcesses(jobs)
        return
    with DaskTasks(scheduler, jobs) as runner:
        yield runner
