"""The contenders: each mapping method, and every reading of its maps that gives it a fair chance."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from taichi_mrf import LogOddsMap, MRFMap, VisibilityMap, WavemapMap
from taichi_mrf.config.schema import to_yaml
from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.methods.protocol import OccupancyMap

VISIBILITY_TABLE_I: dict[str, Any] = {"visible_if_occluded": 0.2}
"""Differences of Table I of Schauwecker & Zell from the defaults of VisibilityMap."""

BOTH: dict[str, dict[str, float]] = {"all leaves": {"empty_below": -1e30}, "occupied leaves": {}}
"""Readings of a recursive map: as the metric has it, every known voxel dims a ray; and as such maps are used,
those that are more likely free than occupied let it through."""

OMEGA = "omega"
"""The row of MRFMap by the paper's metric, beside its own, in which rays end on the measured surface where it
is near their likeliest voxel."""


@dataclass(frozen=True)
class Contender:
    """A method with fixed parameters. ``make`` gives an empty map for a scene and a voxel size; ``readings``
    are names and what each changes of the map's Occlusion. With ``surface`` its own row is by the measured
    surface, and that by the likeliest voxels is called OMEGA."""

    name: str
    make: Callable[[Scene, float], OccupancyMap]
    readings: dict[str, dict[str, float]] = field(default_factory=lambda: {"": {}})
    surface: bool = False

    def signature(self, scene: Scene, voxel_size: float) -> str:
        """A short text that changes with any parameter of its maps."""
        parameters = to_yaml(self.make(scene, voxel_size).config) + f"{self.surface}, leaving"
        return hashlib.sha256(parameters.encode()).hexdigest()[:12]


def row_name(contender: str, reading: str) -> str:
    """Name of a contender's row."""
    return f"{contender}, {reading}" if reading else contender


def mrf(name: str = "MRFMap", **parameters: Any) -> Contender:
    """MRFMap with the sensor's noise, as in the paper a ray for each pixel, and otherwise its defaults."""
    parameters = {"ray_density": 0.0} | parameters

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return MRFMap(voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters)

    return Contender(name, make)


def lidar_mrf(name: str = "MRFMap", **parameters: Any) -> Contender:
    """MRFMap as :func:`mrf` has it, with the chance that a lidar's beam passes an occupied voxel."""
    return mrf(name, pass_through=LIDAR_PASS_THROUGH, **parameters)


def log_odds(name: str, **parameters: Any) -> Contender:
    """Independent log-odds, read with and without the voxels that are more likely free."""

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return LogOddsMap(
            voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters
        )

    return Contender(name, make, BOTH)


def visibility(name: str = "visibility map") -> Contender:
    """Schauwecker & Zell with their Table I and the scene's own sigma in place of lambda z^2."""

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return VisibilityMap(
            voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **VISIBILITY_TABLE_I
        )

    return Contender(name, make, BOTH)


def wavemap(name: str = "wavemap-style", **parameters: Any) -> Contender:
    """The measurement model of wavemap, read with and without the voxels that are more likely free."""

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return WavemapMap(
            voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters
        )

    return Contender(name, make, BOTH)


def standard_contenders() -> Sequence[Contender]:
    """All that need no tuning, MRFMap first."""
    return [
        replace(mrf(), surface=True),
        log_odds("OctoMap-style"),
        log_odds("OctoMap-style, bias removed", correct_bias=True),
        visibility(),
    ]
