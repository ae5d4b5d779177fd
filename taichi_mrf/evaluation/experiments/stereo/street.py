"""The street that stereo is judged on, and the maps that are made of it.

K. Schauwecker and A. Zell mapped with the half-resolution disparity images of a slow robot; their recording
is not at hand. Here it is 51 stereo pairs of KITTI, 1.2 m from one to the next, at half resolution too.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf import PinholeCamera, PolynomialNoise, VisibilityMap, open_dataset
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.datasets.stereo.matching import StereoPairs
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.evaluation.experiments.contenders import VISIBILITY_TABLE_I, Contender, log_odds, mrf
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.methods.protocol import OccupancyMap

RECORDING = Path("stereo_kitti/KITTI_sequence_1")
MAX_DEPTH_M = 40.0
"""With lambda = 7.5e-4 per metre, sigma is 1.2 m there."""

TABLE_I: Mapping[str, float] = {"hit": 0.55, "miss": 0.45}
"""Schauwecker & Zell's parameters for OctoMap; those for their own method are VISIBILITY_TABLE_I."""

AT_ONCE = 0.4
"""P(V | C, V) with which the visibility map expands at once: a voxel among others of which nothing is known
is then visible with 0.4 * 0.5 + 0.5, which is q_max. The paper names this parameter, 0.2 in its Table I, as
the choice between speed of expansion and quality."""

PASSES = 30
"""Number of drives along the street where the visibility map grows as in the paper: with Table I it gains at
most four unknown voxels per image, and the authors' robot took 80 images between one mapped pair and the
next. Integrating a pair 30 times before the next one leaves three times as many artefacts."""

STREET: Mapping[str, float] = {"surface_density": 0.07, "outlier_floor": 1e-2, "ray_density": 9.0 / 20.0}
"""MRFMap's parameters: one surface in the 14 m that a ray is long in the median, in place of 2.1 per metre of
a room; and a share of wild matches that come in patches. Chosen on every fourth pair of the first 21, judged
on those half-way between, which are all mapped here and not judged."""


@dataclass(frozen=True)
class Row:
    """A row of the table: who maps, how often the pairs are gone through, the probability from which a
    voxel can count as occupied at all, and whether the map takes the views' own sigma of each pixel."""

    contender: Contender
    passes: int = 1
    least_probability: float = 0.5
    pixel_sigma: bool = False

    @property
    def name(self) -> str:
        """As the table calls it."""
        return self.contender.name

    def build(self, scene: Scene, voxel_size: float) -> OccupancyMap:
        """The map of every second view."""
        m = self.contender.make(scene, voxel_size)
        for _ in range(self.passes):
            for view in scene.views[::2]:
                sigma_m = view.sigma_m if self.pixel_sigma else None
                m.add_keyframe(view.measured_m, view.T_world_camera, scene.camera, view.name, sigma_m=sigma_m)
        m.infer()
        return m


def octomap_style() -> Contender:
    """The baseline: OctoMap's method with the paper's parameters for it."""
    return log_odds("OctoMap-style, Table I", **TABLE_I)


def visibility(name: str = "visibility map, Table I", **parameters: Any) -> Contender:
    """The paper's method with its Table I, but for ``parameters``, fields of VisibilityConfig."""

    def make(scene: Scene, voxel_size: float) -> OccupancyMap:
        return VisibilityMap(
            voxel_size,
            scene.noise,
            volume=scene.volume,
            max_depth=scene.max_depth,
            **(VISIBILITY_TABLE_I | parameters),
        )

    return Contender(name, make)


def visibility_at_once() -> Contender:
    """The paper's method for a camera that moves on before the map has grown."""
    return visibility("visibility map, at once", visible_if_occluded=AT_ONCE)


def mrf_of_street() -> Contender:
    """MRFMap with the stereo noise, for a street."""
    return mrf("MRFMap", **STREET)


def rows() -> list[Row]:
    """All maps of the table; the first is what the others are compared with."""
    # MRFMap does not claim half of a wall that may stand anywhere within 3 sigma; its prior is far below.
    least = 0.03
    no_floor = mrf("MRFMap, outlier_floor 1e-6", **{**STREET, "outlier_floor": 1e-6})
    return [
        Row(octomap_style()),
        Row(log_odds("OctoMap-style, its defaults")),
        Row(visibility()),
        Row(visibility(f"visibility map, Table I, {PASSES} passes"), passes=PASSES),
        Row(visibility_at_once()),
        Row(mrf_of_street(), least_probability=least),
        Row(mrf("MRFMap, sigma of each pixel", **STREET), least_probability=least, pixel_sigma=True),
        Row(no_floor, least_probability=least),
    ]


def street_scene(data: Path, limit: int | None = None) -> Scene:
    """The first ``limit`` pairs, matched, at full resolution. Raises DatasetError if there are none, or
    ConfigError for fewer than two."""
    dataset = open_dataset(data / RECORDING, color=False)
    if not isinstance(dataset, StereoPairs):
        raise DatasetError(f"{data / RECORDING}: expected stereo pairs, found {type(dataset).__name__}")
    frames = [dataset.read(index) for index in range(len(dataset))[:limit]]
    if len(frames) < 2:
        raise ConfigError(f"{data / RECORDING}: {len(frames)} pairs; the experiment needs at least 2")
    views = [
        SceneView(f.name, f.T_world_camera, f.depth_m, f.depth_m, f.depth_m > 0, sigma_m=f.sigma_m)
        for f in frames
    ]
    noise = PolynomialNoise(dataset.rig.sigma())
    return Scene(dataset.name, dataset.camera, noise, VolumeConfig(), MAX_DEPTH_M, views)


def thinned(scene: Scene, stride: int) -> Scene:
    """The scene with every ``stride``-th row and column only. Depths keep the precision that they have at
    full resolution, as the paper's do."""
    k = scene.pinhole
    views = [
        dataclasses.replace(
            view,
            measured_m=np.ascontiguousarray(view.measured_m[::stride, ::stride]),
            true_m=view.true_m[::stride, ::stride],
            judged=view.judged[::stride, ::stride],
            sigma_m=None if view.sigma_m is None else np.ascontiguousarray(view.sigma_m[::stride, ::stride]),
        )
        for view in scene.views
    ]
    height, width = views[0].measured_m.shape
    # Pixel u is the pixel stride * u of the whole image, through whose centre its ray goes.
    camera = PinholeCamera(width, height, k.fx / stride, k.fy / stride, k.cx / stride, k.cy / stride)
    return dataclasses.replace(scene, camera=camera, views=views)
