"""Every ray is dealt to one worker, once, and wherever that writes its steps, the map is the same."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_room import build, probes

from taichi_mrf.inference.workers import Workers
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, I32Array

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]


@kernel
def _deal(workers: Workers, rays: I32, times: I32Array) -> None:
    for worker in range(workers.number):
        for turn in range(workers.turns(rays)):
            ray = workers.ray(worker, turn)
            if ray < rays:
                ti.atomic_add(times[ray], 1)


@settings(max_examples=50)
@given(rays=st.integers(1, 5000), workers=st.integers(1, 40), run=st.integers(1, 300))
def test_every_ray_is_dealt_once(rays: int, workers: int, run: int) -> None:
    times = ti.ndarray(ti.i32, rays)
    times.fill(0)
    _deal(Workers(workers, run, 1, 0), rays, times)
    np.testing.assert_array_equal(times.to_numpy(), 1)


def test_steps_side_by_side_give_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for on_gpu in (False, True):
        monkeypatch.setattr(runtime, "on_gpu", lambda on_gpu=on_gpu: on_gpu)
        found.append(build([0, 1, 2]).occupancy(probes()))
    np.testing.assert_array_equal(*found)
    assert (found[0] > 0.9).sum() > 100
