"""Accuracy of a map on a depth image that it has not seen (MRFMap, sections III-D and V).

For each pixel, the map answers with the depth at which its ray most likely meets the first surface: where
omega (eq. 18) is largest, or where the ray meets the measured surface near there. The pixel is right if that
depth is within a tolerance of the reference depth. One function serves every kind of map.

The paper and its published code disagree on the tolerance and on rays that meet nothing, so all readings are
implemented, and rays without an answer are counted as wrong and reported.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError, FrameError
from taichi_mrf.evaluation.held_out import DepthError, depth_error
from taichi_mrf.geometry.poses import as_pose
from taichi_mrf.queries.survey import SurfaceSurvey
from taichi_mrf.queries.view import Answer, View
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera, check_camera
from taichi_mrf.sensor.noise import CameraNoise, NoiseModel, PolynomialNoise
from taichi_mrf.voxels.layout import BRICK

Tolerance = Literal["voxel", "1.5sigma", "5cm", "sensor"]
TOLERANCES: tuple[Tolerance, ...] = ("voxel", "1.5sigma", "5cm", "sensor")
"""voxel: the depth lies in the answer's voxel (section III-D). 1.5sigma: within 1.5 sigma of its middle, with
a constant sigma of one voxel (section V). 5cm: within 5 cm of its middle (the published code). sensor:
within 1.5 sigma of what the sensor would measure there, bias and sigma being the sensor's own."""

NOT_JUDGED, NO_ANSWER, WRONG, RIGHT = 0, 1, 2, 3
"""Values of a pixel of an accuracy image."""

FACE = 0.01
"""A depth this share of a voxel outside the answer's voxel still counts as inside: surfaces often lie
exactly in the grid's planes, where rounding decides."""

OUTLIERS = 0.01
"""Share of measurements that the log-likelihood treats as outliers, uniform over the sensor's range."""

MISSED = 0.2
"""Share of measurements that the measured surface does not explain where it is near the likeliest voxel."""

LEFT = 0.5
"""A ray with more visibility than this at its end has left the map; the paper does not say how much."""

SURFACE_STD = 0.25
"""Standard deviation of the measured surface in voxels, according to its weights (docs/surfaces.md)."""


@dataclass(frozen=True)
class Accuracy:
    """``score`` and ``unanswered`` are shares of the judged pixels, ``image`` (H, W) int8 gives for each
    pixel whether it is NOT_JUDGED, NO_ANSWER, WRONG or RIGHT."""

    score: float
    unanswered: float
    image: NDArray[np.int8]


@dataclass(frozen=True)
class JudgedView:
    """A view whose rays were cast through a map once, to be scored in any way.

    ``depth_m`` (H, W) is the reference axial depth, 0 where nothing is judged; ``measured_m`` (H, W) is a
    sensor's measurement of it with the noise ``noise``, 0 where there is none.
    """

    depth_m: NDArray[np.float32]
    measured_m: NDArray[np.float32]
    survey: SurfaceSurvey
    voxel_size: float
    max_depth: float
    noise: CameraNoise

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Pixels that count, (H, W)."""
        return self.depth_m > 0

    @property
    def answered(self) -> NDArray[np.bool_]:
        """Judged pixels whose ray meets anything at all, (H, W)."""
        return self.judged & (self.survey.far > 0)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Judged pixels of which the sensor has measured something, (H, W)."""
        return self.judged & (self.measured_m > 0)

    @cached_property
    def answer_m(self) -> NDArray[np.float32]:
        """Axial depth of the likeliest surface, (H, W), NaN where there is no answer."""
        return np.where(self.answered, self.survey.middle, np.float32(np.nan))

    def by_surface(self, surface_m: NDArray[np.float32]) -> "JudgedView":
        """Copy of the view, judged by the map's measured surface: (H, W) its axial depth, NaN where it is not
        near the likeliest voxel (queries.measured_depth), which then stays the answer.

        ``voxel`` is half a voxel to each side of the surface. A measurement is distributed around it with the
        sensor's variance and that of the surface, or, for a share MISSED of them, as the map has it.
        """
        near, half = ~np.isnan(surface_m), np.float32(0.5 * self.voxel_size)
        survey, there = self.survey, np.where(near, surface_m, np.float32(1.0))
        sigma, bias = self.noise.at_pixels(there)
        spread = np.hypot(sigma, SURFACE_STD * self.voxel_size)
        off = (self.measured_m - there - bias) / spread
        around = np.exp(-0.5 * off * off) / (np.sqrt(2.0 * np.pi) * spread)
        likelihood = (1.0 - MISSED) * around + MISSED * survey.likelihood
        return replace(
            self,
            survey=replace(
                survey,
                near=np.where(near, surface_m - half, survey.near),
                far=np.where(near, surface_m + half, survey.far),
                visibility=np.where(near, np.float32(MISSED) * survey.visibility, survey.visibility),
                likelihood=np.where(near, likelihood, survey.likelihood).astype(np.float32),
            ),
        )

    def accuracy(self, tolerance: Tolerance) -> Accuracy:
        """Share of right pixels; with the tolerance "sensor" of those measured, NaN if there are none.

        Raises ConfigError for a tolerance that does not exist.
        """
        within = self._within(tolerance)
        judged = self.measured if tolerance == "sensor" else self.judged
        answered = judged & self.answered
        image = np.where(judged, NO_ANSWER, NOT_JUDGED).astype(np.int8)
        image[answered] = np.where(within[answered], RIGHT, WRONG)
        count = int(judged.sum())
        if count == 0:
            return Accuracy(float("nan"), float("nan"), image)
        right = int((image == RIGHT).sum())
        return Accuracy(right / count, 1.0 - int(answered.sum()) / count, image)

    def only(self, mask: NDArray[np.bool_]) -> "JudgedView":
        """Copy of the view in which only the pixels of a mask (H, W) count."""
        depth, measured = (np.where(mask, image, np.float32(0)) for image in (self.depth_m, self.measured_m))
        return replace(self, depth_m=depth, measured_m=measured)

    def right_or_beyond(self, boundary_m: NDArray[np.floating]) -> float:
        """Share of right pixels by 1.5sigma and the paper's rule for rays that leave the map (section III-D).

        One that keeps more than LEFT of its visibility is right if its depth lies beyond the map's boundary,
        (H, W) axial depth in metres. NaN if no pixel counts.
        """
        left = self.survey.visibility > LEFT
        right = np.where(left, self.depth_m > boundary_m, self.answered & self._within("1.5sigma"))
        return float(right[self.judged].mean()) if self.judged.any() else float("nan")

    def depth_error(self) -> DepthError:
        """Answer minus depth."""
        return depth_error(self.answer_m, self.depth_m)

    def expected_depth_error(self) -> DepthError:
        """The mean depth of the surface, by eq. 16's Omega, minus the depth."""
        expected = np.where(self.answered, self.survey.expected, np.float32(np.nan))
        return depth_error(expected, self.depth_m)

    def log_likelihood(self) -> float:
        """Mean log density (per metre) of the measurements under the map and the sensor's noise; NaN if there
        are none."""
        return float(np.mean(self.log_densities())) if self.measured.any() else float("nan")

    def log_densities(self) -> NDArray[np.float64]:
        """:func:`log_density` of each measurement, row by row, (n,)."""
        survey, measured = self.survey, self.measured
        return log_density(survey.likelihood[measured], survey.visibility[measured], self.max_depth)

    def _within(self, tolerance: Tolerance) -> NDArray[np.bool_]:
        depth, answer = self.depth_m.astype(np.float64), self.survey.middle.astype(np.float64)
        if tolerance == "voxel":
            slack = FACE * self.voxel_size
            return (depth >= self.survey.near - slack) & (depth <= self.survey.far + slack)
        if tolerance == "1.5sigma":
            return np.abs(depth - answer) <= 1.5 * self.voxel_size
        if tolerance == "5cm":
            return np.abs(depth - answer) <= 0.05
        if tolerance == "sensor":
            sigma, bias = self.noise.at_pixels(answer)
            return np.abs(self.measured_m - answer - bias) <= 1.5 * sigma
        raise ConfigError(f"there is no tolerance '{tolerance}'; choose from {', '.join(TOLERANCES)}")


def log_density(
    likelihood: NDArray[np.float32], visibility: NDArray[np.float32], max_depth: float
) -> NDArray[np.float64]:
    """The log density, per metre, of measurements from their ``likelihood`` under the map and the
    ``visibility`` of their rays at the end.

    A share OUTLIERS of the measurements, and what is left of a ray that leaves the map, may come from
    anywhere in the sensor's range, so one pixel cannot cost more than log(OUTLIERS / range).
    """
    anywhere = 1.0 / max_depth
    explained = likelihood + visibility.astype(np.float64) * anywhere
    return np.asarray(np.log((1.0 - OUTLIERS) * explained + OUTLIERS * anywhere))


def judge_view(
    m: VoxelMap,
    depth_m: ArrayLike,
    T_world_camera: ArrayLike,
    camera: Camera,
    *,
    measured_m: ArrayLike | None = None,
    noise: NoiseModel | None = None,
    mask: ArrayLike | None = None,
    view: View | None = None,
    by: Answer = "surface",
) -> JudgedView:
    """Cast the rays of a view's pixels through a map.

    ``depth_m`` is (H, W) axial depth in metres, 0 or NaN where there is none. Where it is the truth,
    ``measured_m`` (H, W) is what the sensor made of it; else it was measured itself. ``noise`` is that of the
    sensor, a constant sigma of one voxel if not given; ``mask`` (H, W) selects the pixels that count, all
    with a depth if not given. ``by="omega"`` ends all rays in their likeliest voxel, as in the paper; else
    they end on the measured surface where it is near. ``view`` takes the place of ``m.view``, by omega.
    Raises FrameError if shapes do not fit or no pixel is left to judge.
    """
    depth = np.asarray(depth_m, np.float32)
    check_camera(camera)
    if depth.shape != camera.shape:
        raise FrameError(
            f"a depth image has the shape {depth.shape}, but the camera has {camera.height} rows and "
            f"{camera.width} columns"
        )
    judged = np.isfinite(depth) & (depth > 0) & (depth <= m.sensor.max_depth)
    if mask is not None:
        wanted = np.asarray(mask, bool)
        if wanted.shape != camera.shape:
            raise FrameError(f"a mask has the shape {wanted.shape}, its depth image {depth.shape}")
        judged &= wanted
    if not judged.any():
        raise FrameError(
            f"no pixel of {depth.size} can be judged: none holds a depth up to {m.sensor.max_depth:g} m"
            + ("" if mask is None else " inside the mask")
        )
    depth = np.where(judged, depth, np.float32(0))
    measured = depth if measured_m is None else np.asarray(measured_m, np.float32)
    if measured.shape != depth.shape:
        raise FrameError(f"a measured depth image has the shape {measured.shape}, the true one {depth.shape}")
    measured = np.where(judged & (measured > 0), measured, np.float32(0))
    rays = np.where(judged & (measured == 0), np.float32(-1), measured)
    table = (noise or PolynomialNoise((m.voxel_size,))).table(camera)
    T, max_depth = as_pose(T_world_camera), m.sensor.max_depth
    survey = (view or m.view).survey(camera, T, max_depth, rays, table, predicting=True)
    judged_view = JudgedView(depth, measured, survey, m.voxel_size, m.sensor.max_depth, table)
    if by == "omega" or view is not None:
        return judged_view
    return judged_view.by_surface(m.measured_depth(judged_view.answer_m, camera, T))


def boundary_depth(
    m: VoxelMap,
    camera: Camera,
    T_world_camera: ArrayLike,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Axial depth (H, W) at which a view's rays leave the map, metres; 0 for those that never enter it.

    The map is a box of the world with the corners ``lower`` and ``upper``, (3,) metres, or that of all its
    bricks.
    """
    T, pool, side = as_pose(T_world_camera), m.view.pool, BRICK * m.voxel_size
    bricks = pool.bricks[pool.in_use]
    if lower is None or upper is None:
        if not len(bricks):
            return np.zeros(camera.shape)
        lower, upper = bricks.min(axis=0) * side, (bricks.max(axis=0) + 1) * side
    directions = camera.rays() @ T[:3, :3].T
    directions[directions == 0] = 1e-30
    first, second = ((np.asarray(corner) - T[:3, 3]) / directions for corner in (lower, upper))
    enter, leave = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    return np.where(leave > np.maximum(enter, 0.0), leave, 0.0)


def accuracy(
    m: VoxelMap,
    depth_m: ArrayLike,
    T_world_camera: ArrayLike,
    camera: Camera,
    tolerance: Tolerance = "voxel",
    *,
    noise: NoiseModel | None = None,
    mask: ArrayLike | None = None,
    by: Answer = "surface",
) -> Accuracy:
    """Score a map on one depth image: :func:`judge_view`, then :meth:`JudgedView.accuracy`. ``by="omega"`` is
    the paper's metric."""
    if tolerance not in TOLERANCES:
        raise ConfigError(f"there is no tolerance '{tolerance}'; choose from {', '.join(TOLERANCES)}")
    return judge_view(m, depth_m, T_world_camera, camera, noise=noise, mask=mask, by=by).accuracy(tolerance)
