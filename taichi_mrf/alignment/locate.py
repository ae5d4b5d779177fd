"""Pose of a depth image that is no keyframe: where it fits what keyframes have measured."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.keyframe_pictures import ColorLevel
from taichi_mrf.alignment.keyframe_surfels import KeyframeSurfels
from taichi_mrf.alignment.levels import (
    LEAST_POINTS,
    aligned,
    aligned_with_color,
    bounds,
    grids_of,
    levels_of,
    margin_m,
)
from taichi_mrf.alignment.levenberg import Aligned
from taichi_mrf.alignment.locate_around import found_around
from taichi_mrf.alignment.oriented_points import OrientedPoints, oriented_points
from taichi_mrf.alignment.point_to_plane import LARGEST_COST, NormalEquations, PointToPlane
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.seen_through import Sightlines, looked_through
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.wide_search import Around
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage, Keyframe


@dataclass(frozen=True)
class Located:
    """Pose of an image, the (4, 4) ``T_world_camera``; None if that is not known, for ``reason``.

    ``overlap`` is the share of its points with a surface near them, ``agreement`` the share of those that lie
    on it, by Tukey's measure; ``residual_m`` their RMS distance from it, and ``directions`` how many of the
    six directions the points determine. In the others the pose is that of the guess.
    """

    T_world_camera: Pose | None
    reason: str = ""
    overlap: float = 0.0
    agreement: float = 0.0
    residual_m: float = float("nan")
    directions: int = 0


class Locator:
    """Locates images in a ``surface``. Its grids are rebuilt when it changes or the camera has moved on."""

    def __init__(self, surface: KeyframeSurfels) -> None:
        self._surface = surface
        self._grids: list[SurfelGrid] = []
        self._revision = -1
        self._box: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def locate(
        self,
        image: DepthImage,
        guesses: Sequence[Pose],
        keyframes: Mapping[int, Keyframe],
        config: PoseConfig,
        around: Around | None = None,
        colors: Callable[[Pose], Sequence[ColorLevel]] | None = None,
        observable: float = RULES.observable,
    ) -> Located:
        """The pose of an image in what some keyframes have measured. A search begins at each of the guesses;
        the end that fits best and is nearest to its guess counts. ``config`` bounds how far from a guess, and
        how much overlap is needed. If that finds nothing, or nothing that fits well, the image of a sensor
        that sees around is searched for ``around``, and the outcome of that counts. ``colors``, of a camera
        that does not, is what the image can be compared with at a pose. ``observable``: the share of the
        largest eigenvalue that a direction needs to be moved in by depth near the guesses."""
        points = oriented_points(image, self._surface.max_depth)
        if len(points.points) < LEAST_POINTS:
            return Located(None, "too few points on smooth surfaces")
        self._surface.update(keyframes)
        if around is None:
            return self._near(points, guesses, config, 0.0, colors, observable)
        near, sight = self._near(points, guesses, config, RULES.around_finest_m), Sightlines.of(image)
        begin = [] if near.T_world_camera is None else [near.T_world_camera]
        well = bool(begin) and near.overlap * near.agreement > RULES.well
        if well and sight.seen_through(self._grids[-1].surface, begin[0]) < RULES.scan_through:
            return near
        surface = self._surface.around(*around.box(points))
        end, reason = found_around(points, sight, surface, around, begin, config, RULES.observable)
        return _judged(end, reason, config)

    def looked_through(self, image: DepthImage, T_world_camera: Pose) -> float:
        """The share of the surface that the image located last looks through from a pose (4, 4)."""
        return looked_through(self._grids[-1].surface, image, T_world_camera)

    def _near(
        self,
        points: OrientedPoints,
        guesses: Sequence[Pose],
        config: PoseConfig,
        finest_m: float,
        colors: Callable[[Pose], Sequence[ColorLevel]] | None = None,
        observable: float = RULES.observable,
    ) -> Located:
        """The best of the ends of searches from some guesses, in cells of ``finest_m`` metres at the end, and
        from there on with colour, unless depth would fit worse."""
        levels = levels_of(points, self._grids_around(points, guesses, finest_m))
        lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
        priors = [Recorded(T, config) for T in guesses]
        ends = [
            _not_carried_away(levels, T, prior, lever_m, observable)
            for T, prior in zip(guesses, priors, strict=True)
        ]
        # Ends that fit alike differ in how far they are from their guess if depth determines too little.
        worth = max(end.equations.worth for end in ends)
        costs = [
            worth * end.equations.cost + prior.cost(end.T_world_camera)
            for end, prior in zip(ends, priors, strict=True)
        ]
        best = int(np.argmin(costs))
        guess, end = guesses[best], ends[best]
        compared = colors(end.T_world_camera) if colors is not None else ()
        if compared:
            T = end.T_world_camera
            colored = aligned_with_color(levels, compared, T, priors[best], lever_m, RULES.observable)
            least = max(RULES.least_agreement, agreement(end.equations) - RULES.worse_by_color)
            if colored.equations.overlap >= config.min_overlap and agreement(colored.equations) > least:
                end = colored
        turned, shifted = tangent_norms(guess, end.T_world_camera)
        reason = ""
        if shifted > config.max_translation or turned > config.max_rotation:
            reason = f"it fits only {shifted:.2f} m and {turned:.2f} radians from where it was expected"
        return _judged(end, reason, config)

    def _grids_around(
        self, points: OrientedPoints, guesses: Sequence[Pose], finest_m: float
    ) -> list[SurfelGrid]:
        lower, upper = bounds(points, guesses, margin_m(max(self._surface.cell_size, finest_m)))
        held = self._box is not None and (lower >= self._box[0]).all() and (upper <= self._box[1]).all()
        if not held or self._revision != self._surface.revision:
            self._box = (lower - RULES.grids_ahead_m, upper + RULES.grids_ahead_m)
            self._grids = grids_of(self._surface.around(*self._box), RULES.first_cells_m, finest_m)
            self._revision = self._surface.revision
        return self._grids


def _not_carried_away(
    levels: Sequence[PointToPlane], guess: Pose, prior: Recorded, lever_m: float, observable: float
) -> Aligned:
    """End of a search from a guess. If it is far from there, directions that depth determines badly are left
    out, unless they change little."""
    end = aligned(levels, guess, prior, lever_m, observable)
    if tangent_norms(guess, end.T_world_camera)[1] < RULES.carried_m:
        return end
    sure = aligned(levels, guess, prior, lever_m, RULES.observable_by_depth)
    carried_m = tangent_norms(sure.T_world_camera, end.T_world_camera)[1]
    return end if carried_m < RULES.carried_m else sure


def _judged(end: Aligned, reason: str, config: PoseConfig) -> Located:
    """Verdict on an image whose search has ended: its pose cannot be relied on if ``reason`` is not "", or if
    too little of the image fits."""
    overlap, agrees = end.equations.overlap, agreement(end.equations)
    if overlap < config.min_overlap:
        reason = (
            f"{100 * overlap:.0f}% of its points lie near what is mapped, "
            f"and {100 * config.min_overlap:.0f}% are needed"
        )
    elif agrees < RULES.least_agreement:
        reason = f"{100 * agrees:.0f}% of its points agree with the map"
    pose = None if reason else end.T_world_camera
    return Located(pose, reason, overlap, agrees, end.equations.rms_m, end.directions)


def agreement(equations: NormalEquations) -> float:
    """Share of the points with a surface near them that lie on it, by Tukey's measure."""
    beyond = LARGEST_COST * (equations.total - equations.matched)
    return 1.0 - (equations.cost - beyond) / (LARGEST_COST * max(1, equations.matched))
