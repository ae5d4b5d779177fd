"""Probabilistic occupancy mapping with ray Markov random fields on Taichi.

The public names are loaded when first used, so that ``import taichi_mrf`` costs nothing and the
command line can print its help without starting Taichi.
"""

import importlib
from typing import TYPE_CHECKING, Any

from taichi_mrf.system import taichi_environment

if TYPE_CHECKING:
    from taichi_mrf.config.schema import Config as Config
    from taichi_mrf.datasets.registry import open_dataset as open_dataset
    from taichi_mrf.errors import TaichiMRFError as TaichiMRFError
    from taichi_mrf.evaluation.accuracy import accuracy as accuracy
    from taichi_mrf.export.formats import export_map as export_map
    from taichi_mrf.export.options import ExportOptions as ExportOptions
    from taichi_mrf.mapping.merging import merge as merge
    from taichi_mrf.mapping.onto import locate as locate
    from taichi_mrf.methods.chunked import ChunkedMap as ChunkedMap
    from taichi_mrf.methods.chunked_part import take_part as take_part
    from taichi_mrf.methods.log_odds.map import LogOddsMap as LogOddsMap
    from taichi_mrf.methods.mrf.map import MRFMap as MRFMap
    from taichi_mrf.methods.registry import load_map as load_map
    from taichi_mrf.methods.visibility.map import VisibilityMap as VisibilityMap
    from taichi_mrf.methods.wavemap.map import WavemapMap as WavemapMap
    from taichi_mrf.queries.box import read_box as read_box
    from taichi_mrf.queries.box import slice_map as slice_map
    from taichi_mrf.queries.cast import cast_rays as cast_rays
    from taichi_mrf.queries.change import compare_maps as compare_maps
    from taichi_mrf.queries.distance import DistanceField as DistanceField
    from taichi_mrf.queries.frontiers import find_frontiers as find_frontiers
    from taichi_mrf.queries.gain import view_gain as view_gain
    from taichi_mrf.queries.points import FREE as FREE
    from taichi_mrf.queries.points import OCCUPIED as OCCUPIED
    from taichi_mrf.queries.points import UNKNOWN as UNKNOWN
    from taichi_mrf.sensor.camera import PinholeCamera as PinholeCamera
    from taichi_mrf.sensor.distortion import DistortedCamera as DistortedCamera
    from taichi_mrf.sensor.frame import Frame as Frame
    from taichi_mrf.sensor.noise import PatchNoise as PatchNoise
    from taichi_mrf.sensor.noise import PolynomialNoise as PolynomialNoise
    from taichi_mrf.sensor.own_evidence import sigma_of_confidence as sigma_of_confidence
    from taichi_mrf.sensor.ray_table import RayTable as RayTable
    from taichi_mrf.sensor.spherical import SphericalCamera as SphericalCamera
    from taichi_mrf.session.message_server import publish as publish
    from taichi_mrf.session.own_loop import live as live
    from taichi_mrf.session.own_loop import show as show
    from taichi_mrf.system.runtime import init as init

__version__ = "1.0.0"

taichi_environment.prepare()

_PUBLIC = {
    "init": "taichi_mrf.system.runtime",
    "PinholeCamera": "taichi_mrf.sensor.camera",
    "DistortedCamera": "taichi_mrf.sensor.distortion",
    "SphericalCamera": "taichi_mrf.sensor.spherical",
    "RayTable": "taichi_mrf.sensor.ray_table",
    "PolynomialNoise": "taichi_mrf.sensor.noise",
    "PatchNoise": "taichi_mrf.sensor.noise",
    "MRFMap": "taichi_mrf.methods.mrf.map",
    "LogOddsMap": "taichi_mrf.methods.log_odds.map",
    "VisibilityMap": "taichi_mrf.methods.visibility.map",
    "WavemapMap": "taichi_mrf.methods.wavemap.map",
    "load_map": "taichi_mrf.methods.registry",
    "ChunkedMap": "taichi_mrf.methods.chunked",
    "take_part": "taichi_mrf.methods.chunked_part",
    "locate": "taichi_mrf.mapping.onto",
    "merge": "taichi_mrf.mapping.merging",
    "accuracy": "taichi_mrf.evaluation.accuracy",
    "UNKNOWN": "taichi_mrf.queries.points",
    "FREE": "taichi_mrf.queries.points",
    "OCCUPIED": "taichi_mrf.queries.points",
    "read_box": "taichi_mrf.queries.box",
    "slice_map": "taichi_mrf.queries.box",
    "cast_rays": "taichi_mrf.queries.cast",
    "DistanceField": "taichi_mrf.queries.distance",
    "find_frontiers": "taichi_mrf.queries.frontiers",
    "view_gain": "taichi_mrf.queries.gain",
    "compare_maps": "taichi_mrf.queries.change",
    "export_map": "taichi_mrf.export.formats",
    "ExportOptions": "taichi_mrf.export.options",
    "sigma_of_confidence": "taichi_mrf.sensor.own_evidence",
    "Frame": "taichi_mrf.sensor.frame",
    "open_dataset": "taichi_mrf.datasets",
    "live": "taichi_mrf.session.own_loop",
    "show": "taichi_mrf.session.own_loop",
    "publish": "taichi_mrf.session.message_server",
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
