"""Tasks on a Dask cluster: an existing one, or one that is started on this machine.

Dask distributes the tasks, moves them away from workers that die, and returns the answers. On the worker a
task still runs in a process of its own: Taichi needs the main thread and one backend for the whole process,
and a worker needs its own main thread to answer the scheduler.
"""

import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from taichi_mrf.cluster.child import pickled_task, result_of
from taichi_mrf.cluster.processes import ProcessDiedError, TaskProcesses, environment_of, threads_for
from taichi_mrf.cluster.runner import ATTEMPTS, R, T, TaskLostError, gather, nothing
from taichi_mrf.errors import ClusterError
from taichi_mrf.system.libraries import library

LOCAL = "local"
"""In place of a scheduler's address: start a Dask cluster on this machine."""

CONNECT_SECONDS = 20.0
"""Longest wait for a scheduler's answer, in seconds."""

_GLANCE = 0.5
"""Seconds between checks whether a task was cancelled."""


class DaskTasks:
    """Tasks on the workers of a scheduler, ``jobs`` of them if it is LOCAL; use it as a context, or close it.

    Raises TaichiMRFError if Dask is not installed, and as a context ClusterError if the scheduler does not
    answer.
    """

    def __init__(self, scheduler: str = LOCAL, jobs: int = 1) -> None:
        self._distributed = library("distributed", "tasks on a cluster need", "cluster")
        self.scheduler, self.jobs = scheduler, jobs
        self._open = contextlib.ExitStack()
        self._client: Any = None

    def __enter__(self) -> "DaskTasks":
        self._connected()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from the scheduler; end the cluster if it was started here."""
        self._client = None
        self._open.close()

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """See TaskRunner. Waits for a worker if there is none. A task whose Dask worker has died is
        restarted on another, up to the scheduler's ``allowed-failures``.

        On an exception and on Ctrl-C the running tasks are stopped, and their results dropped. Raises
        ClusterError if the scheduler does not answer, or stops answering.
        """
        client = self._connected()
        share = _Share(self.jobs if self.scheduler == LOCAL else 0, self._slots_by_host(client))
        futures = {
            client.submit(
                answer_on_worker,
                pickled_task(function, task),
                share,
                pure=False,
                priority=-index,
                retries=ATTEMPTS - 1,
            ): index
            for index, task in enumerate(tasks)
        }
        try:
            return gather(tasks, self._as_they_finish(futures), done)
        finally:
            with contextlib.suppress(OSError):
                client.cancel(list(futures), force=True)

    def _as_they_finish(self, futures: dict[Any, int]) -> Iterator[tuple[int, Callable[[], Any]]]:
        for future in self._distributed.as_completed(futures, loop=self._client.loop):
            yield futures[future], partial(self._result, future)

    def _result(self, future: Any) -> Any:
        try:
            return result_of(future.result())
        except ProcessDiedError as death:
            raise TaskLostError.after(death) from death
        except self._distributed.KilledWorker as error:
            raise TaskLostError(
                f"the Dask workers that took it died, the last was {error.last_worker.address}"
            ) from error
        except (self._distributed.CancelledError, OSError) as error:
            raise ClusterError(f"the Dask scheduler at {self.scheduler} is gone") from error

    def _connected(self) -> Any:
        if self._client is not None:
            return self._client
        where: Any = self.scheduler
        try:
            if self.scheduler == LOCAL:
                where = self._open.enter_context(self._own_cluster())
            client = self._distributed.Client(where, timeout=CONNECT_SECONDS, set_as_default=False)
        except BaseException as error:
            self.close()  # __exit__ is not called: the context has not begun
            if isinstance(error, (OSError, ValueError)):
                raise ClusterError(f"no Dask scheduler answers at {self.scheduler}: {error}") from error
            raise
        self._client = self._open.enter_context(client)
        return client

    def _own_cluster(self) -> Any:
        dask = library("dask", "tasks on a cluster need", "cluster")
        self._open.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": ATTEMPTS - 1}))
        return self._distributed.LocalCluster(
            n_workers=self.jobs,
            threads_per_worker=1,
            memory_limit=0,  # that of a worker, which does not include the processes of its tasks
            dashboard_address=None,
            silence_logs=logging.CRITICAL,  # a worker's death is reported by the exception
        )

    def _slots_by_host(self, client: Any) -> dict[str, int]:
        """Number of tasks that the workers on each host take at a time."""
        slots: Counter[str] = Counter()
        for address, threads in client.nthreads().items():
            slots[_host(address)] += threads
        return dict(slots)


class _Share:
    """Number of tasks that share a machine: the workers of our own cluster, or the slots of each host."""

    def __init__(self, workers: int, slots: dict[str, int]) -> None:
        self.workers, self.slots = workers, slots

    def environment(self, worker: Any) -> dict[str, str]:
        """The environment variables of a task on a Dask worker."""
        if self.workers:
            return environment_of(int(worker.name), self.workers)
        return threads_for(self.slots.get(_host(worker.address), worker.state.nthreads))


def answer_on_worker(payload: bytes, share: _Share) -> bytes:
    """Runs in a thread of a Dask worker: the task in a process of its own, until it is cancelled."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()
    processes, finished = TaskProcesses(), threading.Event()

    def watch() -> None:
        while not finished.wait(_GLANCE):
            state = worker.state.tasks.get(key)
            if state is None or state.state != "executing":
                processes.stop()
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        return processes.answer(payload, share.environment(worker))
    finally:
        finished.set()


def _host(address: str) -> str:
    return urlsplit(address).hostname or address
