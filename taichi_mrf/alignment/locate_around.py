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
from taichi_mrf.alignment.seen_through import Sightlines
from taichi_mrf.alignment.surfels import Surfels
from taichi_mrf.alignment.wide_search import APART_RAD, Around, candidates
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms

FIRST_CELLS_M = 0.8
"""Width of the first level's cells. Surfaces are found up to 1.2 m away, about as far as the search leaves
points from where they belong."""

FINEST_CELLS_M = 0.2
"""Width of the last level's cells, unless voxels are wider. A lidar's points are 10 to 40 cm apart at 10 to
20 m: with cells of 10 cm fewer have a surface near them, and 7 of 59 scans of a real building were lost."""

FREE_M, FREE_RAD = 0.5, 0.2
"""Standard deviations of the poses that are aligned, along and about each axis: they count only where depth
tells nothing."""

UNMAPPED = 0.25
"""Cost of a point without a surface near it, relative to one beside a surface. A scan around the corner sees
much that is not mapped yet. If that counted as much, one of 50 scans of a real building, two steps ahead of
the map, would fit two places 6.5 m apart alike."""

SURPRISE = 0.02
"""By how much better a pose has to fit for each squared spread between it and where it is expected. Without
what scans look through, 4 of 51 scans of that building are ambiguous at 0 and 1 at 0.02; with it, none
are."""

CLEARLY = 0.03
"""By how much the best pose has to fit better than any other, for each metre of the spread: after lost frames
many rooms are searched. With 0.03 whatever the spread, at least 6 of 28 scans of 16 rows that were found in
the built-in corridor were in the wrong room; so 14 are found and none is."""

MOST_THROUGH = 0.1
"""Share of the map that a scan may look through. At right poses it is at most 0.06, at wrong ones 0.01 to 0.7
and always more than at the right one of the same scan; it counts in full against a pose."""

LEAST_FIT = 0.35
"""Share of the points that have to lie on the map. The worst of those 51 scans has 0.59, and of scans up to
4.5 m ahead of the map 0.39."""

NEAR_M = 0.4
"""Poses closer than this are one between levels. From 0.5 m off, the second level may end in another
pattern of the walls."""

APART_M = 1.0
"""Poses further apart than this are different places."""

FINER, FINEST = 8, 3
"""How many poses the second and the third level take."""


@dataclass(frozen=True)
class FoundPose:
    """End of an alignment, the share of the map that the scan looks ``through`` from there, and what the
    place is ``worth``, at most 1."""

    end: Aligned
    through: float
    worth: float


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
    levels = levels_of(points, grids_of(surface, FIRST_CELLS_M, FINEST_CELLS_M))
    planes = surface.coarser(max(1, round(FINEST_CELLS_M / surface.cell_size))).planes()
    lever_m = float(np.median(np.linalg.norm(points.points, axis=1)))
    free = replace(config, translation_sigma=FREE_M, rotation_sigma=FREE_RAD)

    def aligned_at(level: int, poses: Sequence[Pose]) -> list[FoundPose]:
        places = []
        for T in poses:
            end = align(levels[level], T, Recorded(T, free), lever_m, observable)
            through = sight.seen_through(planes, end.T_world_camera) if level > 0 else 0.0
            places.append(FoundPose(end, through, worth(end, around) - through))
        return places

    places = aligned_at(0, candidates(points, surface.planes(), around))
    # If depth tells little of the position, the expected one tells more: the same turn is tried there.
    turned = [place.end.T_world_camera.copy() for place in distinct(places, NEAR_M)[:2]]
    for T in turned:
        T[:3, 3] = around.expected_m
    places += aligned_at(0, [*turned, *guesses])
    places = aligned_at(1, [place.end.T_world_camera for place in distinct(places, NEAR_M)[:FINER]])
    places = aligned_at(2, [place.end.T_world_camera for place in distinct(places, NEAR_M)[:FINEST]])
    best, *others = distinct(places, APART_M)
    fit = best.end.equations.fit
    reason = ""
    if fit < LEAST_FIT:
        reason = f"{100 * fit:.0f}% of its points fit the map where it fits best, of all places around"
    elif best.end.directions < 6:
        reason = f"its points determine {best.end.directions} of the six directions of its pose"
    elif best.through > MOST_THROUGH:
        reason = f"it looks through {100 * best.through:.0f}% of the map where it fits best"
    elif others and others[0].worth > best.worth - CLEARLY * around.spread_m:
        apart_rad, apart_m = tangent_norms(best.end.T_world_camera, others[0].end.T_world_camera)
        reason = f"it fits alike at two places, {apart_m:.1f} m and {apart_rad:.1f} radians apart"
    return best.end, reason


def worth(end: Aligned, around: Around) -> float:
    """Share of the points that lie on the map, less for a pose that is far from the expected one; points
    where nothing is mapped count for the most part."""
    away = np.linalg.norm(end.T_world_camera[:3, 3] - around.expected_m) / around.spread_m
    unmapped = 1.0 - end.equations.overlap
    return end.equations.fit + (1.0 - UNMAPPED) * unmapped - SURPRISE * float(away) ** 2


def distinct(places: Sequence[FoundPose], apart_m: float) -> list[FoundPose]:
    """The best first, without those that are within ``apart_m`` metres of a better one and turned like it."""
    found: list[FoundPose] = []
    for place in sorted(places, key=lambda place: -place.worth):
        T = place.end.T_world_camera
        norms = [tangent_norms(better.end.T_world_camera, T) for better in found]
        if all(turned > APART_RAD or shifted > apart_m for turned, shifted in norms):
            found.append(place)
    return found
