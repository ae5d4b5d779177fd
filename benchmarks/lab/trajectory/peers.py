"""A peer on the same walks: Open3D's RGB-D odometry, with and without its pose graph (extra ``bench``).

Each image is aligned with the one before. As in Open3D's reconstruction system, every fifth image is also
aligned with others of those, here with all that its odometry places near by, and the pose graph drops what
contradicts the rest (Choi, Zhou and Koltun, "Robust Reconstruction of Indoor Scenes", 2015).
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.lab.trajectory.walks import Walk
from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.sensor.camera import pinhole
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.system.libraries import library

MAX_DEPTH_M = 4.5
"""Depth that Open3D uses; with 3 and with 8 m it drifts further on most walks."""

KEYFRAME_EVERY = 5
"""Images that Open3D's pose graph may connect, as in its reconstruction system."""

NEAR_M, NEAR_RAD = 1.0, 0.6
"""How far apart its odometry places two of them at most, if they are to be aligned."""

LEAST_FITNESS = 0.3
"""Share of pixels that have to fit, or two images are not connected."""

TRUNCATION_M = 0.07
"""Open3D's own default: residuals beyond it are outliers."""


class PeerMissingError(TaichiMRFError):
    """A peer's library is not installed; the text says what to install."""


@dataclass(frozen=True)
class Peer:
    """The poses that a peer found, by the index of the frame, and the processor's seconds."""

    poses: dict[int, Pose]
    cpu_s: float


class Open3DTracker:
    """Open3D on one walk. Raises PeerMissingError without it."""

    def __init__(self, walk: Walk) -> None:
        o3d = library("open3d", "the comparison needs", "bench", PeerMissingError)
        self._o3d, self._odometry, self._graph = o3d, o3d.t.pipelines.odometry, o3d.pipelines.registration
        k = pinhole(walk.camera, walk.name)
        self._K = o3d.core.Tensor([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], o3d.core.float64)
        colored = walk.frames[0].color is not None
        self._method = self._odometry.Method.Hybrid if colored else self._odometry.Method.PointToPlane
        self._start = walk.frames[0].T_world_camera
        self._images = [self._rgbd(frame) for frame in walk.frames]
        self._steps: list[Pose | None] = []
        self._cpu_s = 0.0

    def odometry(self) -> Peer:
        """From each image to the next. A step that fails is left out, and the camera stands still."""
        begin = time.process_time()
        poses, step = {0: self._start}, np.eye(4)
        self._steps = []
        for index in range(1, len(self._images)):
            # Two guesses, as our tracking has them: standing still, and moving on.
            found = [self._aligned(index, index - 1, guess) for guess in (np.eye(4), step)]
            T_before_now, fitness = max(found, key=lambda each: each[1])
            self._steps.append(T_before_now if fitness > 0 else None)
            step = T_before_now if fitness > 0 else np.eye(4)
            poses[index] = poses[index - 1] @ step
        self._cpu_s = time.process_time() - begin
        return Peer(poses, self._cpu_s)

    def pose_graph(self, odometry: Peer) -> Peer:
        """Open3D's poses with a pose graph over all images."""
        begin = time.process_time()
        graph = self._graph.PoseGraph()
        for T_world_camera in odometry.poses.values():
            graph.nodes.append(self._graph.PoseGraphNode(T_world_camera))
        for index, step in enumerate(self._steps, start=1):
            self._connect(graph, index, index - 1, np.eye(4) if step is None else step, False)
        keyframes = range(0, len(self._images), KEYFRAME_EVERY)
        for target in keyframes:
            for source in keyframes[target // KEYFRAME_EVERY + 1 :]:
                rotation, translation = tangent_norms(odometry.poses[target], odometry.poses[source])
                if rotation > NEAR_RAD or translation > NEAR_M:
                    continue
                guess = inverse(odometry.poses[target]) @ odometry.poses[source]
                T_target_source, fitness = self._aligned(source, target, guess)
                if fitness > LEAST_FITNESS:
                    self._connect(graph, source, target, T_target_source, True)
        self._graph.global_optimization(
            graph,
            self._graph.GlobalOptimizationLevenbergMarquardt(),
            self._graph.GlobalOptimizationConvergenceCriteria(),
            self._graph.GlobalOptimizationOption(TRUNCATION_M, 0.25, 0.1, 0),
        )
        seconds = odometry.cpu_s + time.process_time() - begin
        return Peer({index: np.array(node.pose) for index, node in enumerate(graph.nodes)}, seconds)

    def _rgbd(self, frame: Frame) -> Any:
        tensor, image = self._o3d.core.Tensor, self._o3d.t.geometry.Image
        color = frame.color if frame.color is not None else np.zeros((*frame.depth_m.shape, 3), np.uint8)
        depth = image(tensor(np.ascontiguousarray(frame.depth_m)))
        return self._o3d.t.geometry.RGBDImage(image(tensor(np.ascontiguousarray(color))), depth)

    def _aligned(self, source: int, target: int, guess: Pose) -> tuple[Pose, float]:
        """T_target_source of two images and the share of pixels that fit, 0 if the alignment fails."""
        try:
            found = self._odometry.rgbd_odometry_multi_scale(
                self._images[source],
                self._images[target],
                self._K,
                self._o3d.core.Tensor(guess),
                1.0,
                MAX_DEPTH_M,
                method=self._method,
            )
        except RuntimeError:  # a singular system of equations
            return np.eye(4), 0.0
        return found.transformation.numpy(), float(found.fitness)

    def _connect(self, graph: Any, source: int, target: int, T_target_source: Pose, uncertain: bool) -> None:
        information = self._odometry.compute_odometry_information_matrix(
            self._images[source].depth,
            self._images[target].depth,
            self._K,
            self._o3d.core.Tensor(T_target_source),
            TRUNCATION_M,
            1.0,
            MAX_DEPTH_M,
        ).numpy()
        graph.edges.append(
            self._graph.PoseGraphEdge(source, target, T_target_source, information, uncertain=uncertain)
        )
