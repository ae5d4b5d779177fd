"""The share of a machine that a task gets: some of the cores, and one GPU if there are several."""

import os

from taichi_mrf.system import devices
from taichi_mrf.system.devices import cores

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
THREADS = ("TI_CPU_MAX_NUM_THREADS", "QD_CPU_MAX_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables that Taichi, NumPy's BLAS and OpenCV read; ``runtime.threads``, if given, overrides the first."""


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
