"""A real Dask scheduler and workers, each a process of its own, on the loopback interface."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from live_program import DEADLINE_S

TESTS = Path(__file__).resolve().parent


@dataclass
class DaskCluster:
    """The address of the scheduler, and the processes of its workers."""

    address: str
    workers: list["subprocess.Popen[bytes]"] = field(default_factory=list)


@contextmanager
def dask_cluster(folder: Path, workers: int) -> Iterator[DaskCluster]:
    """Start them in ``folder``; workers take one task at a time, and nobody starts a killed one again. All
    workers are there when the block begins."""
    from distributed import Client

    paths = os.pathsep.join([str(TESTS.parents[1]), str(TESTS)])
    environment = {**os.environ, "PYTHONPATH": paths}
    where = folder / "scheduler.json"

    def start(*arguments: str | Path) -> "subprocess.Popen[bytes]":
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *map(str, arguments)],
            cwd=folder,
            env=environment,
            stderr=subprocess.DEVNULL,
        )

    loopback = ("--host", "127.0.0.1", "--no-dashboard")
    processes = [start("scheduler", *loopback, "--port", "0", "--scheduler-file", where)]
    try:
        while not where.exists() or not where.read_text(encoding="utf-8"):
            assert processes[0].poll() is None, "the scheduler does not start"
            time.sleep(0.05)
        cluster = DaskCluster(json.loads(where.read_text(encoding="utf-8"))["address"])
        one_task = ("--nthreads", "1", "--no-nanny", "--memory-limit", "0")
        for _ in range(workers):
            cluster.workers.append(start("worker", cluster.address, *loopback, *one_task))
        processes += cluster.workers
        with Client(cluster.address, timeout=DEADLINE_S, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=DEADLINE_S)
        yield cluster
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()
