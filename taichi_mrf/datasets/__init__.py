"""Sources of frames: recordings in folders and files, cameras, and the built-in synthetic room.

The names are loaded when first used: the command line takes its flags from here, and prints its help without
loading NumPy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from taichi_mrf.datasets.base import Dataset
    from taichi_mrf.datasets.options import ReadOptions
    from taichi_mrf.datasets.registry import open_dataset

_PLACES = {
    "Dataset": "taichi_mrf.datasets.base",
    "ReadOptions": "taichi_mrf.datasets.options",
    "open_dataset": "taichi_mrf.datasets.registry",
}

__all__ = ["Dataset", "ReadOptions", "open_dataset"]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'taichi_mrf.datasets' has no attribute '{name}'")
    return getattr(importlib.import_module(_PLACES[name]), name)
