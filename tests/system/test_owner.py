"""Maps belong to the thread and the process that started Taichi; everyone else gets a clear error."""

import os
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from new_interpreter import output

import taichi_mrf as tm
from taichi_mrf.errors import BackendError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system import compiler, runtime

CAMERA = PinholeCamera(8, 6, 7.0, 7.0, 3.5, 2.5)
WALL = np.full(CAMERA.shape, 1.0, np.float32)
POINTS = np.zeros((1, 3))

VERBS: dict[str, Callable[[Any], Any]] = {
    "add_keyframe": lambda m: m.add_keyframe(WALL, np.eye(4), CAMERA),
    "remove_keyframe": lambda m: m.remove_keyframe(0),
    "move_keyframe": lambda m: m.move_keyframe(0, np.eye(4)),
    "infer": lambda m: m.infer(),
    "occupancy": lambda m: m.occupancy(POINTS),
    "state": lambda m: m.state(POINTS),
    "voxels": lambda m: m.voxels(),
    "render_depth": lambda m: m.render_depth(CAMERA, np.eye(4)),
    "ray_profile": lambda m: m.ray_profile(np.zeros(3), np.array([0.0, 0.0, 1.0])),
    "statistics": lambda m: m.statistics(),
    "save": lambda m: m.save("never-written.npz"),
    "cast_rays": lambda m: tm.cast_rays(m, POINTS, np.array([[0.0, 0.0, 1.0]]), 2.0),
    "read_box": lambda m: tm.read_box(m, np.zeros(3), np.ones(3)),
    "DistanceField": lambda m: tm.DistanceField(m, 0.5),
    "find_frontiers": lambda m: tm.find_frontiers(m),
    "export_map": lambda m: tm.export_map(m, "never-written.ply"),
    "another map": lambda m: type(m)(0.1),
}


def in_another_thread(call: Callable[[], Any]) -> BaseException | None:
    raised: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run, name="worker")
    thread.start()
    thread.join()
    return raised[0] if raised else None


@pytest.mark.parametrize("kind", [MRFMap, LogOddsMap])
def test_no_verb_works_in_another_thread(one_backend: str, kind: type[Any]) -> None:
    m = kind(0.25, max_depth=3.0)
    m.add_keyframe(WALL, np.eye(4), CAMERA)
    for name, verb in VERBS.items():
        error = in_another_thread(lambda verb=verb: verb(m))
        assert isinstance(error, BackendError), name
        assert f"thread that started {compiler.title()}" in str(error)
        assert "'worker'" in str(error)
    assert list(m.keyframes) == [0]


def test_a_start_in_another_thread_is_refused_once_taichi_runs(one_backend: str) -> None:
    assert isinstance(in_another_thread(runtime.init), BackendError)
    assert runtime.init() == one_backend


def test_threads_that_add_side_by_side_lose_nothing() -> None:
    """The first thread is the owner, the others are told so: nothing is added and then lost."""
    program = """
import threading
import numpy as np
import taichi_mrf as tm
camera = tm.PinholeCamera(8, 6, 7.0, 7.0, 3.5, 2.5)
m = tm.MRFMap(0.25, max_depth=3.0)
added, refused = [], []
def add():
    for _ in range(5):
        try:
            added.append(m.add_keyframe(np.ones((6, 8), np.float32), np.eye(4), camera))
        except tm.TaichiMRFError:
            refused.append(1)
threads = [threading.Thread(target=add) for _ in range(3)]
for thread in threads: thread.start()
add()
for thread in threads: thread.join()
print(sorted(added) == list(range(5)) == sorted(m.keyframes), len(refused))
"""
    assert output(program) == "True 15"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on POSIX only")
def test_a_forked_child_is_told_to_start_a_process_of_its_own() -> None:
    program = """
import os, sys
import numpy as np
import taichi_mrf as tm
m = tm.MRFMap(0.25, max_depth=3.0)
m.occupancy(np.zeros((1, 3)))
child = os.fork()
if child == 0:
    try:
        m.occupancy(np.zeros((1, 3)))
        os._exit(1)
    except tm.TaichiMRFError as error:
        print(error, flush=True)
        os._exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), m.occupancy(np.zeros((1, 3))).shape)
"""
    said, parent = output(program).splitlines()
    assert "this process was forked from one" in said
    assert "spawn" in said
    assert parent == "7 (1,)"


def test_taichi_started_again_by_the_program_is_a_clear_error() -> None:
    program = """
import gc
import numpy as np
from taichi_mrf.system.compiler import ti
import taichi_mrf as tm
camera = tm.PinholeCamera(8, 6, 7.0, 7.0, 3.5, 2.5)
m = tm.MRFMap(0.25, max_depth=3.0)
m.add_keyframe(np.ones((6, 8), np.float32), np.eye(4), camera)
ti.init(arch=ti.cpu, log_level=ti.ERROR)
for verb in (m.infer, m.voxels,
             lambda: tm.MRFMap(0.1), lambda: tm.read_box(m, [0, 0, 0], [1, 1, 1])):
    try:
        verb()
    except tm.TaichiMRFError as error:
        print(" was started again (ti.init or ti.reset)" in str(error))
del m
gc.collect()
print("ended")
"""
    assert output(program).splitlines()[-5:] == ["True"] * 4 + ["ended"]
