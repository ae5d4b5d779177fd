"""One keyframe moved to the pose under which its depth is most likely in the map of the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levenberg import Aligned, align
from taichi_mrf.alignment.likelihood import log_likelihood, map_of_others
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.point_to_plane import NormalEquations, PointToPlane
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import Surfels, merged, surfels_of
from taichi_mrf.config import PoseConfig
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.poses import Pose, tangent_norms
from taichi_mrf.queries.view import View

COARSEST_M = 0.08
"""Width in metres that the first level's cells have at least. Further than 1.5 cells nothing is found."""

THINNED = (4, 2, 1)
"""Which of the points each level takes along rows and columns: strides of 8, 4 and 2 pixels."""

LEAST_POINTS = 50
"""Points that an alignment needs, however small the image."""

IN_PLACE = 0.01
"""A keyframe whose points would move by less than this share of a voxel stays where it is."""


@dataclass(frozen=True)
class RefinedPose:
    """What became of a keyframe's pose.

    ``T_world_camera`` is where it stands now and ``T_before`` where it stood; ``translation_m`` and
    ``rotation_rad`` are how far it was moved. Residuals are the robust RMS distance of its points from the
    others' surface, in metres; log-likelihoods the mean per pixel of its depth in the others' map, per metre.
    ``pixels`` is the number of points that met a surface and ``overlap`` their share; ``directions`` how many
    of the six were told. If not ``accepted``, ``reason`` says why, and the keyframe stays where it was.
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
    """Aligns the keyframes of one map with each other. Surfels of keyframes that have not moved are kept."""

    view: View
    max_depth: float
    _surfels: dict[int, tuple[Pose, Surfels]] = field(default_factory=dict)

    def refine(
        self,
        keyframe: Keyframe,
        keyframes: Mapping[int, Keyframe],
        frozen: Mapping[int, str],
        config: PoseConfig,
        guesses: Sequence[Pose] = (),
    ) -> RefinedPose:
        """The pose at which ``keyframe`` fits all others best; nothing is moved here.

        The search begins at its pose, or at that one of the ``guesses`` that fits better. What messages
        ``keyframe`` has must fit its visible bricks. Keyframes that were ``frozen`` take part if they took
        part in an alignment before.
        """
        start = keyframe.T_world_camera
        outcome = RefinedPose(keyframe.id, keyframe.name, start, start)
        points = oriented_points(keyframe.image, self.max_depth)
        if len(points.points) < LEAST_POINTS:
            return replace(outcome, reason="holds too few points on smooth surfaces")
        levels = _levels(points, self._surfels_around(points, (start, *guesses), keyframe, keyframes, frozen))
        fits = [levels[0].linearised(T) for T in (start, *guesses)]
        best = int(np.argmin([fit.cost for fit in fits]))
        begin = (start, *guesses)[best]
        outcome = replace(outcome, pixels=fits[best].matched, overlap=fits[best].overlap)
        if outcome.overlap < config.min_overlap:
            share = f"{100 * outcome.overlap:.0f}% of its points lie near what others have measured"
            return replace(outcome, reason=f"{share}, and {100 * config.min_overlap:.0f}% are needed")
        lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
        found = _aligned(levels, begin, Recorded(begin, config), lever_m)
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
                log_likelihood_before=log_likelihood(self.view, keyframe, start, self.max_depth),
                log_likelihood_after=log_likelihood(
                    self.view, keyframe, found.T_world_camera, self.max_depth
                ),
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

    def _surfels_around(
        self,
        points: OrientedPoints,
        poses: Sequence[Pose],
        keyframe: Keyframe,
        keyframes: Mapping[int, Keyframe],
        frozen: Mapping[int, str],
    ) -> Surfels:
        """The surfels of all keyframes but one around where its points would be with any of some poses.

        Those of new and moved keyframes are found anew.
        """
        size = self.view.voxel_size
        self._surfels = {id: kept for id, kept in self._surfels.items() if id in keyframes or id in frozen}
        for other in keyframes.values():
            known = self._surfels.get(other.id)
            if other is not keyframe and (known is None or known[0] is not other.T_world_camera):
                found = surfels_of(oriented_points(other.image, self.max_depth), other.T_world_camera, size)
                self._surfels[other.id] = (other.T_world_camera, found)
        lower, upper = _bounds(points, poses)
        margin = 2 * max(size, COARSEST_M)
        others = [surfels for id, (_, surfels) in self._surfels.items() if id != keyframe.id]
        return merged([surfels.within(lower - margin, upper + margin) for surfels in others], size)


def _bounds(points: OrientedPoints, poses: Sequence[Pose]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners of a box, in metres in the world, around the points as seen from each of some poses."""
    world = np.concatenate([points.points @ T[:3, :3].T + T[:3, 3] for T in poses])
    return world.min(axis=0), world.max(axis=0)


def _levels(points: OrientedPoints, surface: Surfels) -> list[PointToPlane]:
    """From coarse to fine: few points and wide cells first, all points and the map's own voxels last."""
    doublings = max(0, int(np.ceil(np.log2(COARSEST_M / surface.cell_size))))
    factors = (2**doublings, 2 ** (doublings // 2), 1)
    return [
        PointToPlane(points.thinned(every), SurfelGrid(surface.coarser(factor)))
        for factor, every in zip(factors, THINNED, strict=True)
    ]


def _aligned(
    levels: Sequence[PointToPlane], T_world_camera: Pose, recorded: Recorded, lever_m: float
) -> Aligned:
    found = align(levels[0], T_world_camera, recorded, lever_m)
    for level in levels[1:]:
        found = align(level, found.T_world_camera, recorded, lever_m)
    return found


def _measured(outcome: RefinedPose, before: NormalEquations, found: Aligned) -> RefinedPose:
    return replace(
        outcome,
        residual_before_m=before.rms_m,
        residual_after_m=found.equations.rms_m,
        pixels=found.equations.matched,
        overlap=found.equations.overlap,
        directions=found.directions,
    )
