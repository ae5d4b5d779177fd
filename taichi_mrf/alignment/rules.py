"""Rules of tracking and of loops: every number by which a pose is searched for, believed or refused.

Most of them were decided by measurements, which are in docs/decisions.md. Angles are in radians, shares
between 0 and 1.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rules:
    """The rules in the order in which a frame meets them: its guesses, the search near them, the wide search
    of a sensor that sees around, the search in a whole map, what makes a pose doubtful, and loops."""

    keyframe_m: float = 0.2
    """Metres from one keyframe to the next where the configuration sets no step: errors of alignment add up
    with each."""

    keyframe_rad: float = 0.2
    """Angle from one keyframe to the next in that case."""

    guess_m: float = 0.03
    """Standard deviation of a guess along each axis, metres: it counts where depth determines little."""

    guess_rad: float = 0.03
    """Standard deviation of a guess about each axis."""

    reach_m: float = 0.4
    """Metres from a guess within which a frame may be found."""

    reach_rad: float = 0.4
    """Angle to a guess within which a frame may be found."""

    longest_ahead: float = 3.0
    """A motion is continued for this many times as long as it was observed, at most."""

    gyro_rad: float = 0.005
    """Standard deviation of a turn by the gyroscope, about each axis."""

    gyro_share: float = 0.1
    """Share by which the gyroscope's bias follows each frame, once there have been 1 / ``gyro_share``."""

    largest_bias_rad_s: float = 0.1
    """Radians per second by which a frame may differ from the gyroscope and still tell its bias."""

    longest_integrated_s: float = 1.0
    """Seconds of a step over which accelerations are integrated, at most."""

    first_gravity_m_s2: float = 3.0
    """Standard deviation of gravity as the mean of the first accelerations: the camera may be moved."""

    gravity_drift_m_s2: float = 0.02
    """Change of gravity and bias together in a second, as the camera turns."""

    found_place_m: float = 0.01
    """Standard deviation, in metres, of a place that was found, against the two before it."""

    proven_m: float = 0.05
    """Metres from its prediction within which a place proves the accelerometer right."""

    known_places: int = 4
    """Keyframes at which a lost camera is searched for, at most."""

    alike: float = 0.5
    """Likeness (alignment/appearance.py) that a keyframe needs to be such a place, or the end of a loop."""

    first_cells_m: float = 0.2
    """Width of the first level's cells near a guess, metres: wide enough for a moderate motion a frame."""

    grids_ahead_m: float = 1.0
    """Metres by which the surface's grids reach beyond the points, so that they serve more than one image."""

    observable: float = 0.0005
    """Least share of the largest eigenvalue that a direction needs to be moved in; others keep the guess."""

    observable_by_depth: float = 0.005
    """Least share where the guess is precise and depth could carry the camera away from it."""

    carried_m: float = 0.08
    """Metres from a guess beyond which the directions that depth determines badly have to prove themselves:
    the pose without them must be as near to it."""

    worse_by_color: float = 0.02
    """Share of the points by which fewer may agree with the map where colours fit than where depth does."""

    least_agreement: float = 0.5
    """Share of the points with a surface near them that must lie on it, or the image was taken elsewhere."""

    well: float = 0.7
    """Share of a scan's points that must lie on the map near a guess, or it is searched for further away."""

    scan_through: float = 0.03
    """Share of the map that a scan found near a guess may look through, or it is searched for as well."""

    around_m: float = 4.0
    """Metres from its last place within which a sensor that sees around is searched for."""

    around_lost_m: float = 2.0
    """Metres by which that grows with each lost frame."""

    most_around_m: float = 10.0
    """Metres that it grows to, at most."""

    expected_m: float = 1.0
    """Standard deviation, in metres for one frame, of a place that follows from constant motion."""

    grid_finest_m: float = 0.25
    """Least width, in metres, of the wide search's cells, which is also the distance between places."""

    grid_widest_m: float = 0.5
    """Largest width of those cells, metres."""

    cells_to_median: int = 12
    """Cells that the median of a scan's ranges is long, within those bounds."""

    headings: int = 96
    """Headings that are tried, 3.75 degrees apart."""

    farthest_cells: int = 40
    """Cells beyond which points are left out: half a step between headings moves them by more than a cell."""

    most_points: int = 500
    """Points that count, one for each cell that holds any, so that near ones are not the most."""

    candidates: int = 8
    """Poses that come out of the wide search, at most."""

    candidates_apart: float = 2.0
    """Cells within which a pose is no candidate of its own beside a better one."""

    apart_rad: float = 0.3
    """Angle within which two poses are turned alike."""

    upright: float = float(np.cos(np.radians(45.0)))
    """Cosine of the largest angle between a floor's normal and what was upwards before."""

    level: float = float(np.cos(np.radians(10.0)))
    """Cosine of the largest angle between normals that are floors and ceilings of the same building."""

    around_first_m: float = 0.8
    """Width of the first level's cells around, metres: surfaces are found about as far away as the wide
    search leaves points from where they belong."""

    around_finest_m: float = 0.2
    """Width of the last level's cells around, metres: a lidar's points are that far apart."""

    around_free_m: float = 0.5
    """Standard deviation of the candidates along each axis, metres: they count where depth tells nothing."""

    around_free_rad: float = 0.2
    """Standard deviation of the candidates about each axis."""

    one_pose_m: float = 0.4
    """Metres within which two poses are one between levels."""

    places_apart_m: float = 1.0
    """Metres beyond which two poses are different places."""

    second_level: int = 8
    """Poses that the second level takes."""

    third_level: int = 3
    """Poses that the third level takes."""

    unmapped: float = 0.25
    """Cost of a point without a surface near it, relative to one beside a surface: a scan around the corner
    sees much that is not mapped yet."""

    surprise: float = 0.02
    """Fit that a pose has to gain for each squared spread between it and where it is expected."""

    clearly: float = 0.03
    """Fit by which the best pose has to exceed any other, for each metre of the spread."""

    scan_most_through: float = 0.1
    """Share of the map that a scan found around may look through."""

    least_fit: float = 0.35
    """Share of the points that have to lie on the map where a scan is found around."""

    whole_frames: int = 10
    """Frames of a stretch of a recording that is searched for in a whole map."""

    whole_fewest: int = 5
    """Frames of which a stretch needs to be, at least: one view of a wall or of a corridor fits by chance."""

    whole_stretches: int = 6
    """Stretches of a recording that are searched for, at most, before it is refused."""

    whole_points: int = 10000
    """Points of a stretch, about."""

    whole_walls: int = 20000
    """Cells of the map's surface that may be looked through, at most."""

    whole_finest_m: float = 0.05
    """Width of the last level's cells in a whole map, metres."""

    whole_aside_m: float = 3.0
    """Metres aside from the cameras of a map within which another camera is searched for, or the median of
    its ranges, if that is more: from further away it sees little of what they saw."""

    whole_rise_m: float = 1.0
    """Metres above and below them."""

    whole_candidates: int = 24
    """Poses that come out of the wide search of a whole map, at most."""

    whole_places: int = 5
    """Poses that the finer levels take."""

    whole_through: float = 0.05
    """Share of the map that the images of a camera may look through where they are found in a whole map."""

    whole_scan_through: float = 0.03
    """That share for the scans of a sensor that sees around, whose sightlines are coarser."""

    whole_voxels_through: float = 0.03
    """That share for a camera in a map of which only voxels are left."""

    whole_drift_m: float = 15.0
    """Metres of a recording's path, from stretch to stretch, on which its own poses drift so little that the
    others confirm where one was found."""

    whole_in_free: float = 0.08
    """Share of the images' points that may lie where the map is free, there: things that were moved, and a
    stereo camera's errors."""

    whole_scan_in_free: float = 0.03
    """That share for scans."""

    whole_free_m: float = 0.2
    """Metres around a point, at least two voxels, that have to be free as well."""

    whole_agreement: float = 0.75
    """Share of the points with a surface near them that have to lie on it, there."""

    whole_clearly: float = 0.15
    """Fit by which the place has to exceed any other."""

    whole_colored: int = 500
    """Points of which both the map and the images have colours, for these to count."""

    whole_color_worth: float = 0.3
    """Worth of a place's colours, for a correlation of 1 of their brightness with the map's: wrong places
    have .4, right ones .9."""

    whole_alike: float = 0.5
    """Correlation that they need to have."""

    whole_sigma_m: float = 0.005
    """Sigma of the alignment of a stretch with a map, along the direction that it determines best, metres:
    the map's keyframes and the recording's poses are wrong by so much among themselves."""

    most_through: float = 0.3
    """Share of what is mapped that a camera's image may look through while it is tracked."""

    lost_through: float = 0.05
    """That share after lost frames, and for loops: a wall fits by chance, but not what stood before it."""

    relocated: int = 3
    """Frames in a row that a lost camera's image has to fit near one place before it is there again."""

    long_lost: int = 10
    """Lost frames after which a camera's image has to fit without any doubt."""

    strict_overlap: float = 0.8
    """Least share of its points near what is mapped, then."""

    strict_through: float = 0.012
    """Largest share of what is mapped that it may look through, then."""

    loop_points: int = 5000
    """Points of a keyframe that are aligned for the pose graph, about."""

    recent: int = 10
    """Keyframes before a new one that are no loop."""

    step_partners: int = 3
    """Recent keyframes that a new one is aligned with."""

    step_m: float = 0.05
    """Standard deviation of the guess of a step when it is measured, metres."""

    step_rad: float = 0.03
    """Standard deviation of that guess about each axis."""

    tracked_m: float = 0.15
    """Standard deviation of a tracked step, metres, which counts where the two images determine nothing."""

    tracked_rad: float = 0.08
    """Standard deviation of a tracked step about each axis."""

    farthest_step_m: float = 1.0
    """Metres from the keyframe before beyond which a camera was found again, not tracked from there."""

    drift_m: float = 0.05
    """Metres by which a tracked camera may be off wherever it goes."""

    drift: float = 0.03
    """Share of its path since then by which it may be off as well."""

    view_m: float = 1.0
    """Metres that two cameras that see the same may stand apart."""

    view_rad: float = 1.0
    """Angle by which they may be turned against each other."""

    loops: int = 3
    """Older keyframes that a new one is aligned with, at most."""

    loop_neighbors: int = 2
    """Keyframes before and after an older one whose surface counts with its own."""

    loop_sigma: float = 1e3
    """Standard deviation of the guesses of a loop, metres and radians: they count for nothing."""

    loop_cells_m: tuple[float, float] = (0.12, 0.5)
    """Bounds of the width of a loop's first cells, metres; in between it is the drift."""

    loop_overlap: float = 0.5
    """Share of the points that must be near the older surface."""

    loop_agreement: float = 0.6
    """Share of those that must lie on it."""

    disagrees_m: float = 0.01
    """Metres by which a loop must be off for the graph to be solved."""

    disagrees_rad: float = 0.005
    """Angle by which it must be off instead."""

    trusted: float = 0.25
    """Least trust of a loop in the solved graph."""

    alone_m: float = 0.2
    """Metres up to which a loop may be off that nothing else confirms."""

    confirmed: int = 2
    """Keyframes from which a loop that is off by more has to be found."""

    most_waiting: int = 12
    """Loops that wait to be confirmed, at most."""

    loop_loss: float = 0.1
    """Log-likelihood of the depth around a loop's ends that closing it may cost."""

    merged_m: float = 0.01
    """Standard deviation, in metres along each axis, of a keyframe's place in a map that is merged."""

    merged_rad: float = 0.005
    """Standard deviation of its turn about each axis."""

    least_motion: float = 0.02
    """Voxels by which what a keyframe sees has to move at least, or it stays."""


RULES = Rules()
