"""Place of a recording in a map of another day, without a guess: where its frames fit of all the map.

A stretch of ten frames, by their own poses one scan, is tried at every place near the cameras of the map and
under every heading (wide_search). What fits best is aligned from coarse to fine, fewer poses at each level.
A place counts only if the surface of the stretch lies on that of the map, its images do not look through
what the map has there, hardly any of it lies where the map is free, its points determine all six directions,
its colours are those of the map, if both have any, and no other place fits nearly as well. Other stretches
of the recording then confirm it: in the mirror image of a room, a few views fit and the others do not.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from taichi_mrf.alignment.levels import LEAST_POINTS, grids_of
from taichi_mrf.alignment.levenberg import align, determined
from taichi_mrf.alignment.locate import agreement
from taichi_mrf.alignment.locate_around import FoundPose, distinct
from taichi_mrf.alignment.oriented_points import STRIDE, OrientedPoints, oriented_points
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.recorded import SURFACE_SIGMA_M, Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.seen_through import Sightlines, looked_through
from taichi_mrf.alignment.surfel_grid import SurfelGrid
from taichi_mrf.alignment.surfels import Planes, Surfels, surfels_of
from taichi_mrf.alignment.wide_search import best_poses, level_frame, upright
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.geometry.up import up_vector
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.queries.box import map_extent
from taichi_mrf.queries.points import FREE as FREE_SPACE
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import sees_around

UNKNOWN = np.full((6, 6), np.inf)

THINNED = (8, 2, 1)
"""One point in so many is aligned at the coarse levels."""

FREE = PoseConfig(translation_sigma=RULES.around_free_m, rotation_sigma=RULES.around_free_rad)


@dataclass(frozen=True)
class LocatedRecording:
    """Place of a recording in a map: ``T_map_recording`` (4, 4) takes its world to that of the map. None if
    it is not known, for ``reason``; ``places`` are the two that look alike, if that is the reason.

    ``covariance`` (6, 6) is that of the twist (rho, omega) of the middle camera of the ``frames``, in its
    frame. ``overlap`` is the share of what the frames see that lies near the map, ``agreement`` the share of
    that which lies on it, ``through`` the share of the map that they would look through, and ``in_free`` the
    share of what they see that would lie where the map is free. ``colors`` is the correlation of their
    brightness with that of the map, NaN unless both have colours.
    """

    T_map_recording: Pose | None
    reason: str = ""
    covariance: NDArray[np.float64] = field(default_factory=UNKNOWN.copy)
    overlap: float = 0.0
    agreement: float = 0.0
    through: float = 0.0
    in_free: float = 0.0
    colors: float = np.nan
    places: tuple[Pose, ...] = ()
    frames: tuple[str, ...] = ()

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the camera's place, metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of the camera's turn."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    def in_words(self) -> str:
        """``3 cm, 0.8 degrees, 91% of what is seen agrees``, or why it is not known."""
        if self.T_map_recording is None:
            return self.reason
        sigma_m, degrees = 100 * self.sigma_m, np.degrees(self.sigma_rad)
        return f"{sigma_m:.0f} cm, {degrees:.1f} degrees, {self.agreement:.0%} of what is seen agrees"

    def to_json(self) -> dict[str, Any]:
        """Plain values, lengths in metres."""
        T = self.T_map_recording
        return {
            "T_map_recording": None if T is None else T.tolist(),
            "covariance": self.covariance.tolist(),
            "overlap": self.overlap,
            "agreement": self.agreement,
            "looked_through": self.through,
            "in_free_space": self.in_free,
            "colors": None if np.isnan(self.colors) else self.colors,
            "frames": list(self.frames),
            "says": self.in_words(),
        }


@dataclass(frozen=True)
class WholeMap:
    """What a map shows of its world: its ``surface``, the ``walls`` that several of its keyframes have
    measured, which nothing can look through, the places ``cameras_m`` (N, 3) of its keyframes, and ``up``
    (3,), upwards in its world to 45 degrees. ``is_free`` tells of points (N, 3), in metres, which lie in free
    space, (N,), and ``colors`` their colours (N, 4) with weights. ``most_through`` is the share of the walls
    that a camera's images may look through."""

    surface: Surfels
    walls: Planes
    cameras_m: NDArray[np.float64]
    up: NDArray[np.float64]
    is_free: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    colors: Callable[[NDArray[np.float64]], NDArray[np.uint8]] | None = None
    most_through: float = RULES.whole_through

    @cached_property
    def planes(self) -> Planes:
        """The surface where a wide search looks for it."""
        return self.surface.coarser(max(1, round(RULES.around_finest_m / self.surface.cell_size))).planes()

    @cached_property
    def coarse(self) -> list[SurfelGrid]:
        """Levels on which candidates are aligned."""
        return grids_of(self.surface, RULES.around_first_m, RULES.around_finest_m)

    @cached_property
    def fine(self) -> list[SurfelGrid]:
        """Levels on which the best of them are."""
        return grids_of(self.surface, RULES.around_finest_m, RULES.whole_finest_m)[1:]

    def may_look_through(self, stretch: "Scan") -> float:
        """The share of the walls that a stretch may look through."""
        return RULES.whole_scan_through if stretch.around else self.most_through

    def in_free(self, points_m: NDArray[np.float64]) -> float:
        """The share of points (N, 3) around which all is free."""
        reach_m = max(RULES.whole_free_m, 2 * self.surface.cell_size)
        free = self.is_free(points_m)
        for step in reach_m * np.concatenate([np.eye(3), -np.eye(3)]):
            free[free] = self.is_free(points_m[free] + step)
        return float(free.mean())


def map_of_voxels(m: VoxelMap) -> WholeMap:
    """What the voxels of a map show whose keyframes' images are gone: as its surface the occupied ones beside
    free space, all of which are walls, with the direction of that space for a normal; as places of cameras
    whatever is free."""
    marginals, voxel_m, up = m.marginals, m.voxel_size, m.up
    assert up is not None

    def is_free(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        return marginals.state(points_m) == FREE_SPACE

    centres_m, _ = m.voxels()
    open_to = np.zeros(centres_m.shape)
    for step in np.argwhere(np.ones((5, 5, 5))) - 2:
        if 0 < step @ step <= 5:
            open_to[is_free(centres_m + voxel_m * step)] += step / np.linalg.norm(step)
    lengths = np.linalg.norm(open_to, axis=1)
    beside = lengths > 1
    points = OrientedPoints(
        centres_m[beside].astype(np.float32),
        (open_to[beside] / lengths[beside, None]).astype(np.float32),
        np.full(beside.sum(), voxel_m / 4, np.float32),
        np.zeros((beside.sum(), 2), np.int32),
    )
    surface = surfels_of(points, np.eye(4), 2 * voxel_m)
    lower_m, upper_m = map_extent(m)
    number = np.ceil((upper_m - lower_m) / RULES.grid_widest_m).astype(int)
    places_m = lower_m + RULES.grid_widest_m * np.argwhere(np.ones(number))
    walls = walls_of(surface, [surface, surface])
    return WholeMap(
        surface, walls, places_m[is_free(places_m)], up_vector(up), is_free,
        m.colors if m.has_colors else None, RULES.whole_voxels_through,
    )  # fmt: skip


def walls_of(surface: Surfels, parts: Sequence[Surfels]) -> Planes:
    """What cannot be looked through of a map's surface: cells in which more than one of its ``parts``, those
    of its keyframes, have measured something. RULES.whole_walls of them, evenly, if there are more."""
    keys, number = np.unique(np.concatenate([part.keys for part in parts]), return_counts=True)
    rows = np.flatnonzero(np.isin(surface.keys, keys[number > 1]))
    some = np.linspace(0, len(rows) - 1, min(len(rows), RULES.whole_walls)).astype(np.int64)
    return surface.chosen(rows[some]).planes()


class Scan(ABC):
    """Points that are searched for in a whole map as if one sensor had seen them all: in the frame of a pose
    ``T_recording_scan`` (4, 4) of their own world, in which ``up`` (3,) points up to 45 degrees."""

    views = RULES.whole_fewest
    """Images that the points are from."""

    names: tuple[str, ...] = ()
    """Those of the frames."""

    around = False
    """True if the sensor sees around."""

    def __init__(
        self, T_recording_scan: Pose, points: OrientedPoints, up: NDArray[np.float64],
        colors: NDArray[np.uint8] | None = None,
    ) -> None:  # fmt: skip
        """``colors`` (N, 3) are those of the points, 0 0 0 where they are not known."""
        self.T_recording_scan, self.points, self.up = T_recording_scan, points, up
        self._brightness = None if colors is None else _brightness(colors)

    @cached_property
    def lever_m(self) -> float:
        """Distance of a typical point, metres."""
        return float(np.median(np.linalg.norm(self.points.points, axis=1)))

    def points_from(self, T_map_scan: Pose) -> NDArray[np.float64]:
        """The points (N, 3), in metres in the map, from a pose (4, 4)."""
        return self.points.points.astype(np.float64) @ T_map_scan[:3, :3].T + T_map_scan[:3, 3]

    def alike(self, whole: WholeMap, T_map_scan: Pose) -> float:
        """Correlation of the points' brightness with that of a map where they lie from a pose (4, 4); NaN
        unless both have enough colours."""
        if self._brightness is None or whole.colors is None:
            return float("nan")
        there = whole.colors(self.points_from(T_map_scan))
        both = (there[:, 3] > 0) & np.isfinite(self._brightness)
        if both.sum() < RULES.whole_colored:
            return float("nan")
        seen, mapped = self._brightness[both], _brightness(there[both, :3])
        spread = float(seen.std() * mapped.std())  # none where all is of one brightness
        return float(np.cov(seen, mapped, bias=True)[0, 1]) / spread if spread > 0 else float("nan")

    @abstractmethod
    def looks_through(self, surface: Planes, T_map_scan: Pose) -> float:
        """The share of a mapped surface that cannot be there if the scan was taken at a pose (4, 4)."""


class Stretch(Scan):
    """Some frames of a recording as one scan, in the frame of the middle one's camera."""

    def __init__(
        self,
        images: Sequence[DepthImage],
        T_recording_camera: Sequence[Pose],
        max_depth: float,
        colors: Sequence[NDArray[np.uint8] | None] = (),
        names: tuple[str, ...] = (),
    ) -> None:
        """``images`` with their poses (4, 4) in the recording's world; points up to ``max_depth`` metres
        count. ``colors`` (H, W, 3) are the images' own, if they have any, and ``names`` those of the
        frames."""
        self.names = names
        T_recording_scan = T_recording_camera[len(images) // 2]
        T_scan_recording = inverse(T_recording_scan)
        self.T_scan_camera = [T_scan_recording @ T for T in T_recording_camera]
        self.images, self.views = images, len(images)
        ups = [T[:3, :3] @ image.camera.up for image, T in zip(images, self.T_scan_camera, strict=True)]
        of_each = RULES.whole_points // len(images)
        parts = [oriented_points(image, max_depth).about(of_each) for image in images]
        seen = None
        if colors and all(color is not None for color in colors):
            pairs = zip(parts, colors, strict=True)
            seen = np.concatenate(
                [c[tuple(STRIDE * part.places.T[::-1])] for part, c in pairs if c is not None]
            )
        super().__init__(T_recording_scan, _one_scan(parts, self.T_scan_camera), np.mean(ups, axis=0), seen)
        self.around = sees_around(images[0].camera)
        self._sights = [Sightlines.of(image) for image in images] if self.around else []

    def looks_through(self, surface: Planes, T_map_scan: Pose) -> float:
        """The share of it that the images look through, in the mean."""
        poses = [T_map_scan @ T for T in self.T_scan_camera]
        if self._sights:
            shares = [sight.seen_through(surface, T) for sight, T in zip(self._sights, poses, strict=True)]
        else:
            pairs = zip(self.images, poses, strict=True)
            shares = [looked_through(surface, image, T) for image, T in pairs]
        return float(np.mean(shares))


def _brightness(colors: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The brightness (N,) of colours (N, 3); NaN of black ones, which no camera saw."""
    weights = np.array([0.299, 0.587, 0.114])
    return np.asarray(np.where(colors.any(axis=1), colors @ weights, np.nan))


def _one_scan(parts: Sequence[OrientedPoints], poses: Sequence[Pose]) -> OrientedPoints:
    """Points of several images in one frame."""
    pairs = list(zip(parts, poses, strict=True))
    points = [part.points @ T[:3, :3].T + T[:3, 3] for part, T in pairs]
    normals = [part.normals @ T[:3, :3].T for part, T in pairs]
    return OrientedPoints(
        np.concatenate(points).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.places for part in parts]),
    )


def locate_stretch(stretch: Scan, whole: WholeMap, T_map_recording: Pose | None = None) -> LocatedRecording:
    """The place of a stretch in a whole map, or a refusal. If it is thought to be at ``T_map_recording``
    (4, 4), it is looked for only near there."""
    points, views = stretch.points, stretch.views
    if views < RULES.whole_fewest:
        return LocatedRecording(None, f"too little seen: {views} views, and {RULES.whole_fewest} are needed")
    if len(points.points) < LEAST_POINTS or len(whole.planes.points_m) < LEAST_POINTS:
        return LocatedRecording(None, "too little seen: hardly any point lies on a smooth surface")
    # 1. Every heading at every place near the map's cameras.
    if T_map_recording is None:
        poses = _candidates(stretch, whole)
    else:
        poses = [T_map_recording @ stretch.T_recording_scan]

    # 2. From coarse to fine, the best of them.
    def aligned(grid: SurfelGrid, every: int, poses: Sequence[Pose]) -> list[FoundPose]:
        problem = PointToPlane(points.chosen(slice(None, None, every)), grid)
        found = []
        for T in poses:
            end = align(problem, T, Recorded(T, FREE), stretch.lever_m, RULES.observable)
            through = stretch.looks_through(whole.walls, end.T_world_camera)
            in_free = whole.in_free(stretch.points_from(end.T_world_camera))
            found.append(FoundPose(end, through, end.equations.fit - through - in_free, in_free))
        return distinct(found, RULES.one_pose_m)

    places: list[FoundPose] = []
    for grid, every in zip(whole.coarse, THINNED, strict=True):
        places = aligned(grid, every, poses)
        poses = [place.end.T_world_camera for place in places]
    for grid in whole.fine:
        places = aligned(grid, 1, poses[: RULES.whole_places])
        poses = [place.end.T_world_camera for place in places]
    # 3. What the best is worth, and whether any other is worth nearly as much.
    return _judged(stretch, whole, places) if places else LocatedRecording(None, "it fits nowhere")


def locate_any(
    stretches: Iterable[Scan], whole: WholeMap, T_map_recording: Pose | None = None, nothing: str = ""
) -> LocatedRecording:
    """The place of the first stretch that is found, as :func:`locate_stretch`; those of a list confirm each
    other. ``nothing`` is the reason if there are none."""
    best = LocatedRecording(None, nothing)
    for number, stretch in enumerate(stretches):
        found = replace(locate_stretch(stretch, whole, T_map_recording), frames=stretch.names)
        if isinstance(stretches, list):
            found = _confirmed(found, number, stretches, whole)
        if found.T_map_recording is not None:
            return found
        # Of several refusals the one counts that says most: two places that look alike, or the best fit.
        if number == 0 or (len(found.places), found.overlap) > (len(best.places), best.overlap):
            best = found
    return best


def _confirmed(
    found: LocatedRecording, number: int, stretches: Sequence[Scan], whole: WholeMap
) -> LocatedRecording:
    """The place that was ``found`` of the stretch with this ``number``, or a refusal if the stretches of the
    recording around it look through more of the map there than one may, in the mean. Each may be aligned
    first, since the recording's own poses drift."""
    T_map_recording = found.T_map_recording
    if T_map_recording is None:
        return found
    places_m = np.array([stretch.T_recording_scan[:3, 3] for stretch in stretches])
    path_m = np.cumsum([0.0, *np.linalg.norm(np.diff(places_m, axis=0), axis=1)])
    near = np.flatnonzero(np.abs(path_m - path_m[number]) <= RULES.whole_drift_m)
    shares, weights = [found.through], [found.overlap]
    for other in (stretches[i] for i in near.tolist() if i != number):
        there = locate_stretch(other, whole, T_map_recording)
        as_recorded = other.looks_through(whole.walls, T_map_recording @ other.T_recording_scan)
        shares.append(min(there.through, as_recorded))
        weights.append(there.overlap)
    through = float(np.average(shares, weights=weights))
    if through <= whole.may_look_through(stretches[number]):
        return found
    reason = f"where a part fits best, the others would look through {through:.0%} of what is mapped"
    return replace(found, T_map_recording=None, reason=f"another place: {reason}")


def _candidates(stretch: Scan, whole: WholeMap) -> list[Pose]:
    up_map = upright(whole.planes.normals, whole.up)
    T_first = np.eye(4)
    # An upright scan amid the cameras: any heading will do.
    T_first[:3, :3] = level_frame(up_map).T @ level_frame(stretch.up / np.linalg.norm(stretch.up))
    T_first[:3, 3] = np.median(whole.cameras_m, axis=0)
    aside_m = max(RULES.whole_aside_m, stretch.lever_m)

    def near_cameras(cell_m: float, R_level_world: NDArray[np.float64]) -> NDArray[np.int64]:
        cells = np.rint((whole.cameras_m - T_first[:3, 3]) @ R_level_world.T / cell_m).astype(np.int64)
        aside, rise = (int(np.ceil(m / cell_m)) for m in (aside_m, RULES.whole_rise_m))
        reach = np.array([aside, aside, rise])
        lowest = cells.min(axis=0) - reach
        near = np.zeros(cells.max(axis=0) + reach + 1 - lowest, bool)
        near[tuple((cells - lowest).T)] = True
        x, y, _ = np.ogrid[-aside : aside + 1, -aside : aside + 1, 0:1]
        near = ndimage.binary_dilation(near, x**2 + y**2 <= aside**2)
        near = ndimage.binary_dilation(near, np.ones((1, 1, 2 * rise + 1), bool))
        return np.argwhere(near) + lowest

    number = RULES.whole_candidates
    return best_poses(stretch.points, whole.planes, T_first, up_map, near_cameras, number)


def _judged(stretch: Scan, whole: WholeMap, places: Sequence[FoundPose]) -> LocatedRecording:
    """Verdict on the best of several places, whose worth colours raise."""
    colors = [stretch.alike(whole, place.end.T_world_camera) for place in places]
    gains = RULES.whole_color_worth * np.nan_to_num(colors)
    rated = [replace(each, worth=each.worth + gain) for each, gain in zip(places, gains, strict=True)]
    order = sorted(range(len(rated)), key=lambda i: -rated[i].worth)
    best, *others = (rated[i] for i in order)
    equations, T_scan_recording = best.end.equations, inverse(stretch.T_recording_scan)
    seen = LocatedRecording(
        None,
        overlap=equations.overlap,
        agreement=agreement(equations),
        through=best.through,
        in_free=best.in_free,
        colors=colors[order[0]],
    )
    most = whole.may_look_through(stretch)
    reason = _objection(seen, best, most, RULES.whole_scan_in_free if stretch.around else RULES.whole_in_free)
    if reason:
        return replace(seen, reason=reason)
    alike = [place for place in others if place.worth > best.worth - RULES.whole_clearly]
    T_map_recording = [place.end.T_world_camera @ T_scan_recording for place in (best, *alike)]
    if alike:
        apart_rad, apart_m = tangent_norms(best.end.T_world_camera, alike[0].end.T_world_camera)
        first, second = (_place_of(place) for place in (best, alike[0]))
        reason = (
            f"two places look alike, {apart_m:.1f} m and {np.degrees(apart_rad):.0f} degrees apart: "
            f"{first} and {second}"
        )
        return replace(seen, reason=reason, places=tuple(T_map_recording[:2]))
    certain = equations.worth * (SURFACE_SIGMA_M / RULES.whole_sigma_m) ** 2
    information = certain * determined(equations.H, stretch.lever_m, RULES.observable)
    covariance = np.linalg.pinv(information).astype(np.float64)
    return replace(seen, T_map_recording=T_map_recording[0], covariance=covariance)


def _objection(seen: LocatedRecording, best: FoundPose, through: float, in_free: float) -> str:
    """Reason to doubt the place that fits best, with what is ``seen`` there and at most may be; empty if
    there is none."""
    fit, where = best.end.equations.fit, "another place: where it fits best,"
    if fit < RULES.least_fit:
        return f"another place, or too little of it seen: {fit:.0%} of what is seen fits where most does"
    if seen.agreement < RULES.whole_agreement:
        return f"{where} {seen.agreement:.0%} of what is seen agrees"
    if seen.through > through:
        return f"{where} it would look through {seen.through:.0%} of what is mapped"
    if seen.in_free > in_free:
        return f"{where} {seen.in_free:.0%} of what is seen lies where the map is free"
    if seen.colors < RULES.whole_alike:
        return f"{where} its colours are not those of the map (correlation {seen.colors:.1f})"
    if best.end.directions < 6:
        return f"too little seen: it determines {best.end.directions} of the six directions of its place"
    return ""


def _place_of(place: FoundPose) -> str:
    x, y, z = place.end.T_world_camera[:3, 3]
    return f"({x:.1f}, {y:.1f}, {z:.1f}) m"
