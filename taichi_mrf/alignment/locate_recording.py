"""Place of a recording in a map of another day, without a guess: where its frames fit of all the map.

A stretch of ten frames, by their own poses one scan, is tried at every place near the cameras of the map and
under every heading (wide_search). What fits best is aligned from coarse to fine, fewer poses at each level.
A place counts only if the surface of the stretch lies on that of the map, its images do not look through
what the map has there, hardly any of it lies where the map is free, its points determine all six directions,
its colours are those of the map, if both have any, and no other place fits nearly as well. Other stretches
of the recording then confirm it: in the mirror image of a room, a few views fit and the others do not.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.levels import LEAST_POINTS
from taichi_mrf.alignment.levenberg import align, determined
from taichi_mrf.alignment.locate import agreement
from taichi_mrf.alignment.locate_around import FoundPose, distinct
from taichi_mrf.alignment.point_to_plane import PointToPlane
from taichi_mrf.alignment.recorded import SURFACE_SIGMA_M, Recorded
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.scan import Scan
from taichi_mrf.alignment.seen_through import through_and_seen
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.alignment.whole_map import WholeMap
from taichi_mrf.alignment.wide_search import best_poses, level_frame, upright
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.geometry.poses import Pose, inverse, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage

UNKNOWN = np.full((6, 6), np.inf)

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


def locate_stretch(scan: Scan, whole: WholeMap, T_map_recording: Pose | None = None) -> LocatedRecording:
    """The place of a stretch in a whole map, or a refusal. If it is thought to be at ``T_map_recording``
    (4, 4), it is looked for only near there."""
    if scan.views < RULES.whole_fewest:
        needed = RULES.whole_fewest
        return LocatedRecording(None, f"too little seen: {scan.views} views, but {needed} are needed")
    if len(scan.points.points) < LEAST_POINTS or len(whole.planes.points_m) < LEAST_POINTS:
        return LocatedRecording(None, "too little seen: hardly any point lies on a smooth surface")
    # 1. Every heading at every place near the map's cameras.
    near = None if T_map_recording is None else [T_map_recording @ scan.T_recording_scan]
    poses = _candidates(scan, whole) if near is None else near
    # 2. From coarse to fine, the best of them.
    places: list[FoundPose] = []
    for grid, every, most in whole.levels:
        problem = PointToPlane(scan.points.chosen(slice(None, None, every)), grid)
        found = []
        for T in poses[:most]:
            end = align(problem, T, Recorded(T, FREE), scan.lever_m, RULES.observable)
            through = scan.looks_through(whole.walls, end.T_world_camera)
            in_free = whole.in_free(scan.points_from(end.T_world_camera))
            found.append(FoundPose(end, through, end.equations.fit - through - in_free, in_free))
        places = distinct(found, RULES.one_pose_m)
        poses = [place.end.T_world_camera for place in places]
    # 3. What the best is worth, and whether any other is worth nearly as much.
    return _judged(scan, whole, places) if places else LocatedRecording(None, "it fits nowhere")


def locate_any(
    stretches: Iterable[Scan], whole: WholeMap, T_map_recording: Pose | None = None, nothing: str = ""
) -> LocatedRecording:
    """The place of the first stretch that is found, as :func:`locate_stretch`; those of a list confirm each
    other. ``nothing`` is the reason if there are none."""
    best = LocatedRecording(None, nothing)
    for number, stretch in enumerate(stretches):
        found = replace(locate_stretch(stretch, whole, T_map_recording), frames=stretch.frames)
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
    if through <= whole.may_look_through(stretches[number].around):
        return found
    reason = f"where a part fits best, the others would look through {through:.0%} of what is mapped"
    return replace(found, T_map_recording=None, reason=f"another place: {reason}")


class PlaceCheck:
    """Doubts where a recording was located once what is mapped there does not fit: once its keyframes look
    through a larger share of the map's ``walls`` than ``most``."""

    def __init__(self, walls: Planes, most: float) -> None:
        self._walls, self._most = walls, most
        self._keyframes = self._through = self._seen = 0
        self._is_doubtful = False

    def take(self, image: DepthImage, T_map_camera: Pose) -> str:
        """Take the image of a keyframe, at its pose (4, 4) in the map. Returns why the place is in doubt, if
        that shows with this keyframe, else an empty text."""
        through, seen = through_and_seen(self._walls, image, T_map_camera)
        self._keyframes += 1
        self._through += through
        self._seen += seen
        share = self._through / max(1, self._through + self._seen)
        if self._is_doubtful or self._keyframes < RULES.whole_frames or share <= self._most:
            return ""
        self._is_doubtful = True
        return (
            f"the recording may have been located in a wrong place: its first {self._keyframes} keyframes "
            f"look through {share:.0%} of what the map has there (usually at most {self._most:.0%}); or "
            "its poses drift, or much has been moved since"
        )


def _candidates(scan: Scan, whole: WholeMap) -> list[Pose]:
    up_map = upright(whole.planes.normals, whole.up)
    T_first = np.eye(4)
    # An upright scan amid the cameras: any heading will do.
    T_first[:3, :3] = level_frame(up_map).T @ level_frame(scan.up / np.linalg.norm(scan.up))
    T_first[:3, 3] = np.median(whole.cameras_m, axis=0)
    aside_m = max(RULES.whole_aside_m, scan.lever_m)

    def near_cameras(cell_m: float, R_level_world: NDArray[np.float64]) -> NDArray[np.int64]:
        cells = np.rint((whole.cameras_m - T_first[:3, 3]) @ R_level_world.T / cell_m).astype(np.int64)
        aside, rise = (int(np.ceil(m / cell_m)) for m in (aside_m, RULES.whole_rise_m))
        reach = np.array([aside, aside, rise])
        lowest = cells.min(axis=0) - reach
        near = np.zeros(cells.max(axis=0) + reach + 1 - lowest, np.uint8)
        near[tuple((cells - lowest).T)] = 1
        x, y = np.ogrid[-aside : aside + 1, -aside : aside + 1]
        disc = (x**2 + y**2 <= aside**2).astype(np.uint8)
        near = np.stack([cv2.dilate(level, disc) for level in np.moveaxis(near, 2, 0)], axis=-1)
        column = np.ones((1, 2 * rise + 1), np.uint8)
        near = cv2.dilate(near.reshape(-1, near.shape[2]), column).reshape(near.shape)
        return np.argwhere(near) + lowest

    return best_poses(scan.points, whole.planes, T_first, up_map, near_cameras, RULES.whole_candidates)


def _judged(scan: Scan, whole: WholeMap, places: Sequence[FoundPose]) -> LocatedRecording:
    """Verdict on the best of several places, whose worth colours raise."""
    colors = [scan.alike(whole, place.end.T_world_camera) for place in places]
    gains = RULES.whole_color_worth * np.nan_to_num(colors)
    rated = [replace(each, worth=each.worth + gain) for each, gain in zip(places, gains, strict=True)]
    order = sorted(range(len(rated)), key=lambda i: -rated[i].worth)
    best, *others = (rated[i] for i in order)
    equations, T_scan_recording = best.end.equations, inverse(scan.T_recording_scan)
    seen = LocatedRecording(
        None,
        overlap=equations.overlap,
        agreement=agreement(equations),
        through=best.through,
        in_free=best.in_free,
        colors=colors[order[0]],
    )
    reason = _objection(seen, best, scan, whole)
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
    information = certain * determined(equations.H, scan.lever_m, RULES.observable)
    covariance = np.linalg.pinv(information).astype(np.float64)
    return replace(seen, T_map_recording=T_map_recording[0], covariance=covariance)


def _objection(seen: LocatedRecording, best: FoundPose, scan: Scan, whole: WholeMap) -> str:
    """Reason to doubt the place that fits best, with what is ``seen`` there; empty if there is none."""
    fit, where = best.end.equations.fit, "another place: where it fits best,"
    if fit < RULES.least_fit:
        return f"another place, or too little of it seen: {fit:.0%} of what is seen fits where most does"
    if seen.agreement < RULES.whole_agreement:
        return f"{where} {seen.agreement:.0%} of what is seen agrees"
    if seen.through > whole.may_look_through(scan.around):
        return f"{where} it would look through {seen.through:.0%} of what is mapped"
    if seen.in_free > (RULES.whole_scan_in_free if scan.around else RULES.whole_in_free):
        return f"{where} {seen.in_free:.0%} of what is seen lies where the map is free"
    if seen.colors < RULES.whole_alike:
        return f"{where} its colours are not those of the map (correlation {seen.colors:.1f})"
    if best.end.directions < 6:
        return f"too little seen: it determines {best.end.directions} of the six directions of its place"
    return ""


def _place_of(place: FoundPose) -> str:
    x, y, z = place.end.T_world_camera[:3, 3]
    return f"({x:.1f}, {y:.1f}, {z:.1f}) m"
