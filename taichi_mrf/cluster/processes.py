"""The processes of tasks, seen from the one that starts them, and the share of a machine that each gets.

Neither multiprocessing nor ProcessPoolExecutor works here: a Dask worker is a daemon, which must not start
their processes; a pool breaks as a whole when one process is killed; and the environment of a process has
to be set before it starts, because NumPy and Taichi read it when they are loaded.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping

from taichi_mrf.cluster.child import read_block, write_block
from taichi_mrf.system import devices
from taichi_mrf.system.devices import cores

_LAST_SECONDS = 60.0
"""Longest wait for the end of a process that has answered, in seconds."""

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
THREADS = ("TI_CPU_MAX_NUM_THREADS", "QD_CPU_MAX_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables that Taichi, NumPy's BLAS and OpenCV read; ``runtime.threads``, if given, overrides the first."""


class ProcessDiedError(Exception):
    """A process died before it answered; the text says how."""


class StoppedError(Exception):
    """The tasks were stopped before this one answered."""


class TaskProcesses:
    """The processes of the running tasks; used from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopping = False

    def answer(self, payload: bytes, environment: Mapping[str, str]) -> bytes:
        """The result of child.answer_to for the payload, from a new process with these environment
        variables added.

        Raises ProcessDiedError if the process dies, StoppedError if the tasks were asked to stop.
        """
        process = self._start(environment)
        try:
            answer = _exchange(process, payload)
        finally:
            self._forget(process)
        if answer is not None:
            return answer
        if self._stopping:
            raise StoppedError
        raise ProcessDiedError(_end(process.returncode))

    def stop(self) -> None:
        """Ask all to stop, and start no more."""
        with self._lock:
            self._stopping = True
            for process in self._running:
                process.terminate()

    def kill(self) -> None:
        """End all at once, and start no more."""
        with self._lock:
            self._stopping = True
            for process in self._running:
                process.kill()

    def _start(self, environment: Mapping[str, str]) -> "subprocess.Popen[bytes]":
        code = f"import sys; sys.path[:] = {sys.path!r}; from taichi_mrf.cluster.child import main; main()"
        with self._lock:
            if self._stopping:
                raise StoppedError
            process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, **environment},
                start_new_session=True,  # Ctrl-C goes to the parent only, which stops its children
            )
            self._running.add(process)
            return process

    def _forget(self, process: "subprocess.Popen[bytes]") -> None:
        """Let a process that has answered end by itself: Taichi saves its compiled kernels then."""
        try:
            if process.poll() is None and not self._stopping:
                process.wait(_LAST_SECONDS)
        except subprocess.TimeoutExpired:
            pass
        finally:
            with self._lock:
                self._running.discard(process)
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    stream.close()


def _exchange(process: "subprocess.Popen[bytes]", payload: bytes) -> bytes | None:
    """Send the task and wait for the answer; None if the process dies instead."""
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(BrokenPipeError):
        write_block(process.stdin, payload)
    answer = read_block(process.stdout)
    if answer is None:
        process.wait()
    return answer


def _end(returncode: int) -> str:
    if returncode >= 0:
        return f"its process ended with exit status {returncode} and no answer"
    return f"its process was killed by {signal.Signals(-returncode).name}"


def gpus() -> list[str]:
    """The CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    visible = os.environ.get(VISIBLE_GPUS)
    if visible is not None:
        return [name for name in visible.split(",") if name]
    return [str(number) for number in range(devices.cuda_device_count())]


def environment_of(worker: int, workers: int) -> dict[str, str]:
    """The environment variables of the ``worker``-th (from 0) of ``workers`` that share this machine."""
    environment = threads_for(workers)
    found = gpus()
    if len(found) > 1:
        environment[VISIBLE_GPUS] = found[worker % len(found)]
    return environment


def threads_for(workers: int) -> dict[str, str]:
    """The environment variables that divide the cores among so many; variables that the user has set are
    not changed."""
    threads = str(max(1, cores() // workers))
    return {name: threads for name in THREADS if workers > 1 and name not in os.environ}
