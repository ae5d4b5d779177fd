"""Parts that tests of tuning share: a few small frames of the built-in room, a coarse map's parameters."""

from functools import cache
from typing import Any

from taichi_mrf.config.schema import Config
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.system import runtime
from taichi_mrf.tune.working_set import WorkingSet, read_working_set
from taichi_mrf.viewer.tune.messages import FrameChoice

ROOM = "synthetic:room?frames=9&width=80&height=60"
_TUNED: dict[str, Any] = {"inference": InferenceConfig(outlier_floor=1e-6)}  # as with_tuned_noise sets it
CONFIG = Config(voxel_size=0.1, **_TUNED)
CHOICE = FrameChoice(stride=1, count=9)


@cache
def room() -> Dataset:
    """Nine views around the room."""
    runtime.init("cpu")
    return open_dataset(ROOM)


@cache
def working_set() -> WorkingSet:
    """Six frames that make the map, two that score it, and one that is kept back."""
    return read_working_set(room(), CHOICE, keep_unseen=True)
