"""Probabilistic occupancy mapping with ray Markov random fields on Taichi.

The public names are loaded when first used, so that ``import taichi_mrf`` costs nothing and the
command line can print its help without starting Taichi.
"""

import importlib
from typing import Any

from taichi_mrf.system import taichi_environment

__version__ = "0.1.0"

taichi_environment.prepare()

_PUBLIC = {
    "init": "taichi_mrf.system.runtime",
    "PinholeCamera": "taichi_mrf.sensor.camera",
    "PolynomialNoise": "taichi_mrf.sensor.noise",
    "PatchNoise": "taichi_mrf.sensor.noise",
    "MRFMap": "taichi_mrf.methods.mrf.map",
    "LogOddsMap": "taichi_mrf.methods.log_odds.map",
    "VisibilityMap": "taichi_mrf.methods.visibility.map",
    "load_map": "taichi_mrf.methods.registry",
    "ChunkedMap": "taichi_mrf.methods.chunked",
    "take_part": "taichi_mrf.methods.chunked_part",
    "accuracy": "taichi_mrf.evaluation.accuracy",
    "UNKNOWN": "taichi_mrf.queries.points",
    "FREE": "taichi_mrf.queries.points",
    "OCCUPIED": "taichi_mrf.queries.points",
    "read_box": "taichi_mrf.queries.box",
    "slice_map": "taichi_mrf.queries.slices",
    "cast_rays": "taichi_mrf.queries.cast",
    "distance_field": "taichi_mrf.queries.distance",
    "find_frontiers": "taichi_mrf.queries.frontiers",
    "view_gain": "taichi_mrf.queries.gain",
    "compare_maps": "taichi_mrf.queries.change",
    "export_map": "taichi_mrf.export.formats",
    "ExportOptions": "taichi_mrf.export.options",
    "Frame": "taichi_mrf.sensor.frame",
    "open_dataset": "taichi_mrf.datasets",
    "Config": "taichi_mrf.config.schema",
    "TaichiMRFError": "taichi_mrf.errors",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'taichi_mrf' has no attribute '{name}'")
    value = getattr(importlib.import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
