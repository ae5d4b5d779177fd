"""The task runners keep their promise: on this machine, and on a real Dask scheduler with two workers."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cluster_tasks
import pytest
from cluster_dask import TESTS, dask_cluster
from in_process import InProcess

from taichi_mrf.cluster import dask_tasks, processes
from taichi_mrf.cluster.choose import open_runner
from taichi_mrf.cluster.dask_tasks import DaskTasks
from taichi_mrf.cluster.local import LocalProcesses
from taichi_mrf.cluster.runner import ATTEMPTS, TaskRunner
from taichi_mrf.errors import ClusterError, ConfigError, DatasetError, TaichiMRFError


@pytest.fixture(scope="module", params=["processes", "dask"])
def runner(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TaskRunner]:
    """Both runners, with two tasks at a time."""
    if request.param == "processes":
        yield LocalProcesses(2)
        return
    with (
        dask_cluster(tmp_path_factory.mktemp("dask"), 2) as cluster,
        open_runner(scheduler=cluster.address) as runner,
    ):
        yield runner


def test_results_are_in_the_order_of_the_tasks_and_told_once(runner: TaskRunner) -> None:
    told: list[tuple[int, int]] = []
    numbers = [5, 3, 3, 8]  # the same task twice is two tasks
    results = runner.run(cluster_tasks.double, numbers, lambda *each: told.append(each))
    assert results == InProcess().run(cluster_tasks.double, numbers) == [10, 6, 6, 16]
    assert sorted(told) == list(enumerate(results))
    assert runner.run(cluster_tasks.double, []) == []


def test_each_task_is_on_the_main_thread_of_its_own_process(runner: TaskRunner) -> None:
    found = runner.run(cluster_tasks.where, [0, 1, 2])
    assert len({pid for pid, _, _ in found} | {os.getpid()}) == 4
    share_of_two = str(max(1, processes.cores() // 2))
    for _, on_main_thread, environment in found:
        assert on_main_thread
        assert environment["TI_CPU_MAX_NUM_THREADS"] == share_of_two


def test_a_task_whose_process_is_killed_begins_again(runner: TaskRunner, tmp_path: Path) -> None:
    told: list[int] = []
    tasks = [(tmp_path, number) for number in range(3)]
    assert runner.run(cluster_tasks.die_once, tasks, lambda index, _: told.append(index)) == [0, 10, 20]
    assert sorted(told) == [0, 1, 2]
    begun = [len((tmp_path / f"{n}.txt").read_text(encoding="utf-8").splitlines()) for n in range(3)]
    assert begun == [1, 2, 1]


def test_a_lost_task_is_named_when_the_others_are_done(runner: TaskRunner) -> None:
    told: dict[int, int] = {}
    with pytest.raises(ClusterError, match=f"task 2 of 3, 1: .* SIGKILL, {ATTEMPTS} times") as caught:
        runner.run(cluster_tasks.always_die, [0, 1, 2], told.__setitem__)
    assert told == {0: 0, 2: 20}
    assert list(caught.value.lost) == [1]


def test_an_exception_of_a_task_is_raised_and_stops_the_others(runner: TaskRunner, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"^number 1 is bad$") as caught:
        runner.run(cluster_tasks.refuse, [(tmp_path, number) for number in range(3)])
    assert not list(tmp_path.iterdir())
    assert "in refuse" in str(caught.value.__cause__)  # where it was raised, for whoever looks for a bug
    with pytest.raises(ClusterError, match="PickyError: 7 and 7"):
        runner.run(cluster_tasks.picky, [7])


def test_ctrl_c_lets_tasks_save_what_they_have(tmp_path: Path) -> None:
    told: dict[int, str] = {}

    def interrupt(index: int, result: str) -> None:
        told[index] = result
        if index == 0:
            while not (tmp_path / "1.pid").exists():
                time.sleep(0.02)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        LocalProcesses(2).run(cluster_tasks.save_when_stopped, [(tmp_path, n) for n in range(4)], interrupt)
    begun = {int(path.stem) for path in tmp_path.iterdir()}
    assert {0, 1} <= begun < {0, 1, 2, 3}
    assert told == {number: "saved" if number else "whole" for number in begun}


def test_tasks_end_with_the_process_that_started_them(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; import cluster_tasks\n"
        "from taichi_mrf.cluster.local import LocalProcesses\n"
        "LocalProcesses().run(cluster_tasks.save_when_stopped, [(Path(sys.argv[1]), 1)])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parents[1]), str(TESTS)])}
    parent = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=environment)
    told = tmp_path / "1.pid"
    while not told.exists() or not told.read_text(encoding="utf-8"):
        assert parent.poll() is None
        time.sleep(0.02)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    child = int(told.read_text(encoding="utf-8"))
    while is_running(child):
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """True if there is such a process that is no zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_each_worker_has_a_gpu_and_its_share_of_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "cores", lambda: 8)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    given = [processes.environment_of(worker, 3) for worker in range(3)]
    assert [each["CUDA_VISIBLE_DEVICES"] for each in given] == ["3", "5", "3"]
    assert all(each["TI_CPU_MAX_NUM_THREADS"] == "2" and "OMP_NUM_THREADS" not in each for each in given)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    assert processes.environment_of(0, 1) == {}


def test_what_cannot_be_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="jobs must be at least 1"):
        LocalProcesses(0)
    monkeypatch.setattr(dask_tasks, "CONNECT_SECONDS", 0.5)
    for address in ("tcp://127.0.0.1:9", "nowhere"):
        with pytest.raises(ClusterError, match=f"no Dask .* {address}"), DaskTasks(address):
            pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(TaichiMRFError, match=r"not installed: pip install 'taichi-mrf\[cluster\]'"):
        DaskTasks()
