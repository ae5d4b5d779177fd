"""The maps of this package as peers: MRFMap as a live run feeds it, and the recursive baselines."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf import FREE, OCCUPIED, LogOddsMap, MRFMap, VisibilityMap, WavemapMap
from taichi_mrf.evaluation.accuracy import JudgedView
from taichi_mrf.evaluation.experiments.contenders import BOTH
from taichi_mrf.evaluation.experiments.judging import judged_by_surface, judged_by_voxels
from taichi_mrf.evaluation.experiments.peers.peer import Answers, Cells, Knob, Mesh, Peer
from taichi_mrf.evaluation.experiments.scenes import Scene, SceneView
from taichi_mrf.evaluation.keyframe_cost import timed
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.export.surface import smooth_surface
from taichi_mrf.methods.protocol import OccupancyMap

BONXAI: dict[str, Any] = {"hit": 0.7, "miss": 0.4, "lowest": 0.12, "highest": 0.97, "discretise": True}
"""The defaults of Bonxai's ProbabilisticMap: one update for each voxel and scan, in which a hit wins, and one
ray to the centre of each voxel that is hit (github.com/facontidavide/Bonxai, probabilistic_map.hpp)."""

WAVEMAP_ON_IMAGES: dict[str, Any] = {"beams": "ray", "scaling_free": 0.2, "scaling_occupied": 0.4}
"""The published model of wavemap for depth cameras, the continuous ray, with a sigma of range of half a voxel
(github.com/ethz-asl/wavemap, wavemap_panoptic_mapping_rgbd.yaml)."""

BEAM_DEG = 0.06
"""Standard deviation of a beam for each pixel of stride, so that each voxel takes the pixel that it is seen
in: six of them are more than half a pixel's diagonal."""

NO_OTHERS = float("inf")
"""A renew_tolerance that leaves the messages of earlier keyframes as they are."""


class MrfPeer:
    """MRFMap: a new keyframe's own sweep, then those to whom it was news, and full sweeps at the end."""

    def __init__(self, scene: Scene, voxel_size: float, knob: Knob) -> None:
        parameters = dict(knob.parameters)
        self._full_sweeps = int(parameters.pop("full_sweeps", 0))
        self._scene = scene
        self.map = MRFMap(
            voxel_size, scene.noise, volume=scene.volume, max_depth=scene.max_depth, **parameters
        )
        self.stages_ms = {"allocation": 0.0, "own sweep": 0.0, "re-inference": 0.0}

    def integration(self, view: SceneView) -> Callable[[], object]:
        """A new keyframe, as a live run treats it."""
        m, added = self.map, list[int]()
        parts = (view.measured_m, view.T_world_camera, view.camera or self._scene.camera, view.name)
        stages: dict[str, Callable[[], object]] = {
            "allocation": lambda: added.append(m.add_keyframe(*parts, stamp_s=view.stamp_s)),
            "own sweep": lambda: m.infer(sweeps=1, keyframes=added),
        }
        if m.config.inference.renew_tolerance < NO_OTHERS:
            stages["re-inference"] = m.renew

        def run() -> None:
            for name, stage in stages.items():
                self.stages_ms[name] += 1e3 * timed(stage).cpu

        return run

    def conclude(self) -> None:
        """Full inference, where the setting has it."""
        if self._full_sweeps:
            self.map.infer(sweeps=self._full_sweeps)

    def answers(self, view: SceneView) -> Mapping[str, Answers]:
        """By omega, and by the measured surface where that is near."""
        return {
            "omega": _answers(judged_by_voxels(self.map, self._scene, view)),
            "surface": _answers(judged_by_surface(self.map, self._scene, view)),
        }

    @cached_property
    def _surface(self) -> FusedSurface:
        return self.map.surface()

    def cells(self, points_m: NDArray[np.float64]) -> Mapping[str, Cells]:
        """By marginals, and by the calibrated reading."""
        calibrated = self.map.calibrated()
        return {
            "marginal": _cells(self.map, points_m),
            "calibrated": _cells(calibrated, points_m),
        }

    def mesh(self) -> Mesh:
        """The measured surface."""
        return self._surface.vertices_m, self._surface.triangles

    @property
    def memory_mb(self) -> float:
        """Voxels, messages, images and scratch."""
        return self.map.statistics().memory_mb


class RecursivePeer:
    """A map that updates each voxel by itself, in the reading that explains held-out views better."""

    def __init__(self, m: OccupancyMap, scene: Scene) -> None:
        self.map, self._scene = m, scene
        self.stages_ms: dict[str, float] = {}

    def integration(self, view: SceneView) -> Callable[[], object]:
        """One scan."""
        camera = view.camera or self._scene.camera
        return lambda: self.map.add_keyframe(
            view.measured_m, view.T_world_camera, camera, view.name, view.stamp_s
        )

    def conclude(self) -> None:
        """Nothing is left to do."""

    def answers(self, view: SceneView) -> Mapping[str, Answers]:
        """Once for each reading."""
        return {
            name: _answers(judged_by_voxels(self.map, self._scene, view, changes))
            for name, changes in BOTH.items()
        }

    def cells(self, points_m: NDArray[np.float64]) -> Mapping[str, Cells]:
        """By its probabilities."""
        return {"": _cells(self.map, points_m)}

    def mesh(self) -> Mesh:
        """Surface where the probability is one half."""
        surface = smooth_surface(self.map, 0.5)
        return surface.vertices_m, surface.triangles

    @property
    def memory_mb(self) -> float:
        """Voxels, images and scratch."""
        return self.map.statistics().memory_mb


def log_odds(scene: Scene, voxel_size: float, knob: Knob) -> Peer:
    """Our log-odds map; with the parameters BONXAI it is the hit/miss map."""
    return RecursivePeer(LogOddsMap(voxel_size, scene.noise, **_shared(scene), **knob.parameters), scene)


def visibility(scene: Scene, voxel_size: float, knob: Knob) -> Peer:
    """The visibility map, whose rays pass unknown voxels at once. With the paper's Table I they do not, which
    needs a camera that moves less than a voxel a frame."""
    return RecursivePeer(VisibilityMap(voxel_size, scene.noise, **_shared(scene), **knob.parameters), scene)


def wavemap(scene: Scene, voxel_size: float, knob: Knob) -> Peer:
    """The measurement model of wavemap: that for images or, for a lidar, that for an Ouster OS0."""
    parameters = dict(knob.parameters)
    if scene.camera.height > 1:
        widths = {"angle_sigma_deg": BEAM_DEG * knob.stride, "range_sigma": 0.5 * voxel_size}
        parameters |= WAVEMAP_ON_IMAGES | widths
    return RecursivePeer(WavemapMap(voxel_size, scene.noise, **_shared(scene), **parameters), scene)


def _shared(scene: Scene) -> dict[str, Any]:
    return {"volume": scene.volume, "max_depth": scene.max_depth}


def _answers(judged: JudgedView) -> Answers:
    return Answers(judged.answer_m, judged.log_likelihood())


def _cells(m: Any, points_m: NDArray[np.float64]) -> Cells:
    state = m.state(points_m)
    return Cells(m.marginals.occupancy(points_m), state == OCCUPIED, state == FREE)
