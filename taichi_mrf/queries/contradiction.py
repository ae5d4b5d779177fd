"""How much a depth image contradicts a map, ray by ray, and which way: something new stands in known-free
space, or a known surface is gone.

With z a measurement and Omega_i the probability that its ray's first surface lies in voxel i (MRFMap,
eq. 16), its density under the map and under the best explanation, a surface right where it was measured, are

    p(z | map)  = (1 - o) (sum_i Omega_i nu(z | i) + U V nu(z | z)) + o / R
    p(z | best) = (1 - o) nu(z | z) + o / R

nu is the sensor model (eq. 4), nu(z | z) that of a surface in the very voxel of the measurement; U is 1 if
that voxel is unknown and else 0, V the visibility at the ray's end, R the range of the sensor, and o the
share of measurements that may come from anywhere. A score is ln p(z | best) - ln p(z | map), at least 0,
with a sign for which way.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.queries.points import UNKNOWN
from taichi_mrf.queries.survey import SurfaceSurvey
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera, check_camera
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.own_evidence import NOTHING, OwnEvidence

OUTLIERS = 0.01
"""Share of the measurements that may come from anywhere in the sensor's range (o)."""


def ray_scores(
    m: VoxelMap,
    depth_m: ArrayLike,
    T_world_camera: ArrayLike,
    camera: Camera,
    own: OwnEvidence = NOTHING,
) -> NDArray[np.float32]:
    """How much each pixel of a depth image contradicts a map, (H, W) float32, in nats (natural logarithms of
    likelihood ratios).

    ``depth_m`` is (H, W) axial depth in metres, where 0, NaN and negative mean no measurement;
    ``T_world_camera`` is (4, 4); ``own`` is what is stated of these measurements. Above 0 the measurement is
    nearer than the map's surface, in space that is known to be free: something new. Below 0 the ray has
    passed through a surface of the map: it is gone. From about 3 on a score is more than noise, and none is
    beyond about 10. It is 0 for what is measured in unknown space, of which the map says nothing, and NaN
    without a measurement between ``sensor.min_depth`` and ``sensor.max_depth``. Raises ConfigError for a
    wrong shape, KeyframeError for an impossible pose.
    """
    check_camera(camera)
    T = as_pose(T_world_camera)
    depth = array(depth_m, "depth_m")
    if depth.shape != camera.shape:
        raise ConfigError(f"depth_m must be of the camera's shape {camera.shape}, not {depth.shape}")
    nearest, farthest = m.sensor.min_depth, m.sensor.max_depth
    judged = (depth > 0) & (depth >= nearest) & (depth <= farthest)  # NaN is not
    measured = np.where(judged, depth, 0.0)
    noise = own.noise_model(m.noise, measured).table(camera)
    survey = m.view.survey(camera, T, farthest, measured.astype(np.float32), noise)
    sigma, bias = noise.at_pixels(measured)
    surface_m = measured - bias
    unknown = np.zeros(camera.shape, bool)
    unknown[judged] = m.state(_points(camera, T, surface_m)[judged]) == UNKNOWN
    best = _best_likelihood(sigma, m.voxel_size)
    under_map = survey.likelihood + np.where(unknown, survey.visibility * best, 0.0)
    scores = np.maximum(_log_mixed(best, farthest) - _log_mixed(under_map, farthest), 0.0)
    gone = _passed_surface(survey, surface_m)
    scores[gone] *= -1.0
    scores[unknown & ~gone] = 0.0
    return np.where(judged, scores, np.nan).astype(np.float32)


def _log_mixed(likelihood: NDArray[np.floating], range_m: float) -> NDArray[np.float64]:
    """ln of a density mixed with that of measurements from anywhere in the sensor's range."""
    mixed: NDArray[np.float64] = np.log((1.0 - OUTLIERS) * likelihood + OUTLIERS / range_m)
    return mixed


def _best_likelihood(sigma: NDArray[np.float64], voxel_size: float) -> NDArray[np.float64]:
    """nu of a surface in the voxel around the measurement: the map cannot place it better. The normal density
    whose variance is that of noise and voxel together is within a few percent of the integral."""
    spread = np.sqrt(2 * np.pi * (sigma**2 + voxel_size**2 / 12))
    return np.minimum(1.0 / spread, 1.0 / voxel_size)


def _passed_surface(survey: SurfaceSurvey, surface_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True where the ray's likeliest surface lies before the measured one, and was expected to stop it."""
    stopped = (survey.visibility < 0.5) & (survey.far > 0)
    return stopped & (survey.far < surface_m)


def _points(camera: Camera, T_world_camera: Pose, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points in the world, (H, W, 3), at (H, W) depths of a camera's pixels."""
    points = points_at(camera, depth_m)
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
