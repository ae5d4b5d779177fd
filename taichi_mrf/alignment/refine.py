"""One keyframe moved to the pose under which its depth is most likely in the map of the others."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.alignment.keyframe_surfels import KeyframeSurfels
from taichi_mrf.alignment.levels import LEAST_POINTS, aligned, bounds, grids_of, levels_of, margin_m
from taichi_mrf.alignment.levenberg import Aligned
from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.alignment.point_to_plane import NormalEquations
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import withdraw_messages
from taichi_mrf.queries.view import View
from taichi_mrf.system import runtime

IN_PLACE = 0.01
"""A keyframe whose points would move by less than this share of a voxel stays where it is."""

STRIDE = 4
"""One pixel in so many, along both axes, is compared."""

OUTLIERS = 0.01
"""Share of the measurements that may come from anywhere in the sensor's range."""


@dataclass(frozen=True)
class RefinedPose:
    """Outcome of the refinement of a keyframe's pose.

    ``T_world_camera`` is where it stands now and ``T_before`` where it stood; ``translation_m`` and
    ``rotation_rad`` are how far it was moved. Residuals are the robust RMS distance of its points from the
    others' surface, in metres; log-likelihoods the mean per pixel of its depth in the others' map, per metre.
    ``pixels`` is the number of points that met a surface and ``overlap`` their share; ``directions`` how many
    of the six were determined. If not ``accepted``, ``reason`` says why, and the keyframe stays where it was.
    """

    keyframe: int
    name: str
    T_world_camera: Pose
    T_before: Pose
    translation_m: float = 0.0
    rotation_rad: float = 0.0
    residual_before_m: float = 0.0
    residual_after_m: float = 0.0
    log_likelihood_before: float = float("nan")
    log_likelihood_after: float = float("nan")
    pixels: int = 0
    overlap: float = 0.0
    directions: int = 0
    accepted: bool = False
    reason: str = ""


@dataclass
class Aligner:
    """Aligns the keyframes of one map with the ``surface`` that they have measured."""

    view: View
    surface: KeyframeSurfels

    def refine(
        self,
        keyframe: Keyframe,
        keyframes: Mapping[int, Keyframe],
        config: PoseConfig,
        guesses: Sequence[Pose] = (),
    ) -> RefinedPose:
        """The pose at which ``keyframe`` fits all others best; nothing is moved here.

        The search begins at its pose, or at that one of the ``guesses`` that fits better. What messages
        ``keyframe`` has must fit its visible bricks.
        """
        start = keyframe.T_world_camera
        outcome = RefinedPose(keyframe.id, keyframe.name, start, start)
        max_depth = self.surface.max_depth
        points = oriented_points(keyframe.image, max_depth)
        if len(points.points) < LEAST_POINTS:
            return replace(outcome, reason="holds too few points on smooth surfaces")
        self.surface.update(keyframes, without=keyframe.id)
        box = bounds(points, (start, *guesses), margin_m(self.surface.cell_size))
        levels = levels_of(points, grids_of(self.surface.around(*box, without=keyframe.id)))
        fits = [levels[0].linearised(T) for T in (start, *guesses)]
        best = int(np.argmin([fit.cost for fit in fits]))
        begin = (start, *guesses)[best]
        outcome = replace(outcome, pixels=fits[best].matched, overlap=fits[best].overlap)
        if outcome.overlap < config.min_overlap:
            share = f"{100 * outcome.overlap:.0f}% of its points lie near what others have measured"
            return replace(outcome, reason=f"{share}, but {100 * config.min_overlap:.0f}% are needed")
        lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
        found = aligned(levels, begin, Recorded(begin, config), lever_m)
        before = levels[-1].linearised(start)
        outcome = _measured(outcome, before, found)
        rotation, translation = tangent_norms(start, found.T_world_camera)
        if translation + lever_m * rotation < IN_PLACE * self.view.voxel_size:
            return replace(outcome, reason="fits where it stands")
        if found.equations.cost >= before.cost:
            return replace(outcome, reason="fits nowhere better")
        turned, shifted = tangent_norms(begin, found.T_world_camera)
        if shifted > config.max_translation or turned > config.max_rotation:
            how_far = f"{shifted:.3f} m and {turned:.3f} radians"
            return replace(outcome, reason=f"fits only {how_far} away, which is further than allowed")
        with map_of_others(self.view, keyframe):
            outcome = replace(
                outcome,
                log_likelihood_before=log_likelihood(self.view, keyframe, start, max_depth),
                log_likelihood_after=log_likelihood(self.view, keyframe, found.T_world_camera, max_depth),
            )
        if outcome.log_likelihood_after < outcome.log_likelihood_before:
            return replace(outcome, reason="its depth would be less likely there")
        return replace(
            outcome,
            T_world_camera=found.T_world_camera,
            translation_m=translation,
            rotation_rad=rotation,
            accepted=True,
        )


def _measured(outcome: RefinedPose, before: NormalEquations, found: Aligned) -> RefinedPose:
    return replace(
        outcome,
        residual_before_m=before.rms_m,
        residual_after_m=found.equations.rms_m,
        pixels=found.equations.matched,
        overlap=found.equations.overlap,
        directions=found.directions,
    )


@contextmanager
def map_of_others(view: View, keyframe: Keyframe) -> Iterator[None]:
    """Let the view see, while the block runs, what all but one keyframe believe (eq. 6).

    The messages of ``keyframe``, if it has any, must fit its visible bricks, and those be up to date.
    """
    cavity = view.pool.snapshot(undated=True)
    if keyframe.messages is not None:
        withdraw_messages(keyframe.visible, keyframe.messages, cavity.belief)
    with view.pool.showing(cavity):
        yield
    runtime.settle()  # before the snapshot is dropped


def log_likelihood(view: View, keyframe: Keyframe, T_world_camera: Pose, max_depth: float) -> float:
    """Mean log density, per metre, of every STRIDE-th pixel's depth, measured from a pose."""
    measured = np.zeros(keyframe.camera.shape, np.float32)
    # Rays without a pattern are rows of their own.
    rows, columns = (slice(STRIDE // 2, None, STRIDE) if n > STRIDE else slice(None) for n in measured.shape)
    measured[rows, columns] = keyframe.depth_m[rows, columns]
    asked = measured > 0
    if not asked.any():
        return float("nan")
    noise = keyframe.image.at_certain_pose.noise_table  # the pose is given here
    survey = view.survey(keyframe.camera, T_world_camera, max_depth, measured, noise)
    anywhere = 1.0 / max_depth
    explained = survey.likelihood[asked] + anywhere * survey.visibility[asked].astype(np.float64)
    return float(np.mean(np.log((1.0 - OUTLIERS) * explained + OUTLIERS * anywhere)))
