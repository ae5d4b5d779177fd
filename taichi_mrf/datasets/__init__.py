"""Sources of frames: recordings in folders and the built-in synthetic room."""

from taichi_mrf.datasets.base import Dataset, ReadOptions
from taichi_mrf.datasets.registry import open_dataset

__all__ = ["Dataset", "ReadOptions", "open_dataset"]
