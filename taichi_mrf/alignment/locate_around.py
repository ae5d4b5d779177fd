"""Pose of a scan of a sensor that sees around, if nothing near the guesses will do.

The poses that a wide search proposes are aligned from coarse to fine, fewer at each level. The one that fits
best counts, unless another place fits almost as well: in a hall of equal bays a scan may lie in any.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.alignment.levels import grids_of, levels_of
from taichi_mrf.alignment.levenberg import Aligned, align
from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.recorded import Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.seen_through import Sightlines
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.alignment.wide_search import Around, candidates
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms


@dataclass(frozen=True)
class FoundPose:
    """End of an alignment, the share of the map that the scan looks ``through`` from there, and what the
    place is ``worth``, at most 1. ``in_free`` is the share of the scan that lies where the map is free, if
    that was asked."""

    end: Aligned
    through: float
    worth: float
    in_free: float = 0.0


def found_around(
    points: OrientedPoints,
    sight: Sightlines,
    surface: Surfels,
    around: Around,
    guesses: Sequence[Pose],
    config: PoseConfig,
    observable: float,
) -> tuple[Aligned, str]:
    """The pose in a ``surface`` at which a scan fits best of all ``around``, and why it cannot be relied on,
    or "". ``guesses`` are tried as well; ``observable`` is that of levenberg.align."""
    levels = levels_of(points, grids_of(surface, RULES.around_first_m, RULES.around_finest_m))
    planes = surface.coarser(max(1, round(RULES.around_finest_m / surface.cell_size))).planes()
    lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
    free = replace(config, translation_sigma=RULES.around_free_m, rotation_sigma=RULES.around_free_rad)

    def aligned_at(level: int, poses: Sequence[Pose]) -> list[FoundPose]:
        places = []
        for T in poses:
            end = align(levels[level], T, Recorded(T, free), lever_m, observable)
            through = sight.seen_through(planes, end.T_world_camera) if level > 0 else 0.0
            places.append(FoundPose(end, through, worth(end, around) - through))
        return places

    places = aligned_at(0, candidates(points, surface.planes(), around))
    # If depth tells little of the position, the expected one tells more: the same turn is tried there.
    turned = [place.end.T_world_camera.copy() for place in distinct(places, RULES.one_pose_m)[:2]]
    for T in turned:
        T[:3, 3] = around.expected_m
    places += aligned_at(0, [*turned, *guesses])
    for level, most in ((1, RULES.second_level), (2, RULES.third_level)):
        best_ones = distinct(places, RULES.one_pose_m)[:most]
        places = aligned_at(level, [place.end.T_world_camera for place in best_ones])
    best, *others = distinct(places, RULES.places_apart_m)
    fit = best.end.equations.fit
    reason = ""
    if fit < RULES.least_fit:
        reason = f"{100 * fit:.0f}% of its points fit the map at the best of all places around"
    elif best.end.directions < 6:
        reason = f"its points determine {best.end.directions} of the six directions of its pose"
    elif best.through > RULES.scan_most_through:
        reason = f"it looks through {100 * best.through:.0f}% of the map where it fits best"
    elif others and others[0].worth > best.worth - RULES.clearly * around.spread_m:
        apart_rad, apart_m = tangent_norms(best.end.T_world_camera, others[0].end.T_world_camera)
        reason = f"it fits two places equally well, {apart_m:.1f} m and {apart_rad:.1f} radians apart"
    return best.end, reason


def worth(end: Aligned, around: Around) -> float:
    """Share of the points that lie on the map, less for a pose that is far from the expected one; points
    where nothing is mapped count for the most part."""
    away = np.linalg.norm(end.T_world_camera[:3, 3] - around.expected_m) / around.spread_m
    unmapped = 1.0 - end.equations.overlap
    return end.equations.fit + (1.0 - RULES.unmapped) * unmapped - RULES.surprise * float(away) ** 2


def distinct(places: Sequence[FoundPose], apart_m: float) -> list[FoundPose]:
    """The best first, without those that are within ``apart_m`` metres of a better one and turned like it."""
    found: list[FoundPose] = []
    for place in sorted(places, key=lambda place: -place.worth):
        T = place.end.T_world_camera
        norms = [tangent_norms(better.end.T_world_camera, T) for better in found]
        if all(turned > RULES.apart_rad or shifted > apart_m for turned, shifted in norms):
            found.append(place)
    return found
