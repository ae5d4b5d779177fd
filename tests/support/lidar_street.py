"""A street with dark, wet and far surfaces, and a lidar that gets no return from some of them.

How much light comes back falls with reflectance, incidence and the square of range, and decides whether there
is a return: not the law by which maps judge missing ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.no_return import NoReturnFit, fit_no_return
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.points import FREE, OCCUPIED
from taichi_mrf.sensor.spherical import SphericalCamera

CAMERA = SphericalCamera(np.radians(np.linspace(14.0, -24.0, 32)), np.radians(np.arange(0.0, 360.0, 1.0)))
SHIFT = np.array([0.013, 0.037, 0.11])
"""Of the street against the grid, whose planes no surface may lie in."""
SIGMA_M = 0.03
REACH_M = 60.0
EYES = [np.array([x, 0.4, 1.8]) for x in (-14.0, -8.0, -2.0, 4.0, 10.0, 16.0)]

DRY, WET, WALL, DARK, BRIGHT = 0.25, 0.004, 0.35, 0.012, 0.6
KINDS = {"dry road": DRY, "wet road": WET, "house": WALL, "dark car": DARK, "bright car": BRIGHT}


@dataclass(frozen=True)
class Box:
    """Corners in metres, and the share of light that its faces reflect."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    reflectance: float


BOXES = [
    *(
        Box((x, y, 0.0), (x + 14.0, y + 4.0, 9.0), WALL)
        for x in (-34.0, -16.0, 2.0, 20.0)
        for y in (-13.0, 9.0)
    ),
    Box((-10.0, 4.0, 0.0), (-6.0, 5.8, 1.5), DARK),
    Box((1.0, -5.6, 0.0), (5.2, -3.8, 1.5), BRIGHT),
    Box((8.0, 4.0, 0.0), (12.2, 5.8, 1.5), DARK),
    Box((17.0, -5.6, 0.0), (21.0, -3.8, 1.5), DARK),
    Box((75.0, -12.0, 0.0), (77.0, 12.0, 9.0), WALL),
]
PUDDLES = ((-4.0, -3.0, 1.5, 2.5), (9.0, -2.5, 15.0, 2.0))
"""First x, first y, last x, last y."""


def first_surface(
    eye: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Range (infinite for the sky), reflectance and cosine of incidence of rays (N, 3) of length 1."""
    count = len(directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(directions[:, 2] < 0, -eye[2] / directions[:, 2], np.inf)
        ground = eye + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * directions
        wet = np.zeros(count, bool)
        for x0, y0, x1, y1 in PUDDLES:
            wet |= (ground[:, 0] > x0) & (ground[:, 0] < x1) & (ground[:, 1] > y0) & (ground[:, 1] < y1)
        reflectance, cosine = np.where(wet, WET, DRY), np.abs(directions[:, 2])
        for box in BOXES:
            low, high = (np.array(corner) - eye for corner in (box.lower, box.upper))
            a, b = low / directions, high / directions
            near, far = np.minimum(a, b), np.maximum(a, b)
            enter, leave = near.max(axis=1), far.min(axis=1)
            hit = (enter > 0) & (enter < leave) & (enter < ranges)
            axis = near.argmax(axis=1)
            ranges = np.where(hit, enter, ranges)
            reflectance = np.where(hit, box.reflectance, reflectance)
            cosine = np.where(hit, np.abs(directions[np.arange(count), axis]), cosine)
    return ranges, reflectance, cosine


@dataclass(frozen=True)
class Scan:
    """A scan from ``eye``: measured ranges (H, W), 0 for none, the true ones, and what reflects."""

    eye: NDArray[np.float64]
    range_m: NDArray[np.float32]
    true_m: NDArray[np.float64]
    reflectance: NDArray[np.float64]

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        T = np.eye(4)
        T[:3, 3] = self.eye + SHIFT
        return T

    @property
    def no_return(self) -> NDArray[np.bool_]:
        return self.range_m == 0


def scans(seed: int = 0) -> list[Scan]:
    """What the lidar measures from all places."""
    rng = np.random.default_rng(seed)
    found = []
    for eye in EYES:
        ranges, reflectance, cosine = first_surface(eye, CAMERA.rays().reshape(-1, 3))
        with np.errstate(divide="ignore"):
            light_db = 10 * np.log10(reflectance * cosine) - 20 * np.log10(ranges / 40.0)
        comes_back = light_db + rng.normal(0.0, 3.0, len(ranges)) > -10.0
        measured = np.where(
            comes_back & (ranges < REACH_M), ranges + rng.normal(0, SIGMA_M, len(ranges)), 0.0
        )
        parts = (measured.astype(np.float32), ranges, reflectance)
        found.append(Scan(eye, *(part.reshape(CAMERA.shape) for part in parts)))
    return found


def mapped(sensor: SensorConfig, voxel_size: float, taken: Sequence[Scan]) -> MRFMap:
    m = MRFMap.from_config(Config(voxel_size=voxel_size, sensor=sensor), CAMERA)
    for scan in taken:
        m.add_keyframe(scan.range_m, scan.T_world_camera, CAMERA, no_return=scan.no_return)
    m.infer()
    return m


@dataclass(frozen=True)
class Judged:
    """Shares of points: free ones that the map has free, and those on each kind of surface, from which a
    return came, that it has occupied and free."""

    free_recall: float
    occupied: dict[str, float]
    freed: dict[str, float]


def judged(m: MRFMap, taken: Sequence[Scan], reach_m: float) -> Judged:
    """Free points are those on the true lines of sight up to ``reach_m``, two voxels and more before surfaces
    and above the road."""
    free: list[NDArray[np.float64]] = []
    occupied, freed = {}, {}
    for scan in taken:
        rays, true = CAMERA.rays().reshape(-1, 3)[::7], scan.true_m.reshape(-1)[::7]
        for depth in np.arange(1.0, reach_m, 1.37):
            free.append((scan.eye + depth * rays)[depth < true - 2.0 * m.voxel_size])
    points = np.concatenate(free)
    points = points[points[:, 2] > 2 * m.voxel_size]
    for kind, reflectance in KINDS.items():
        seen = [(scan, (scan.range_m > 0) & (scan.reflectance == reflectance)) for scan in taken]
        surface = [scan.eye + scan.range_m[back][:, None] * CAMERA.rays()[back] for scan, back in seen]
        states = m.state(np.concatenate(surface) + SHIFT)
        occupied[kind], freed[kind] = float((states == OCCUPIED).mean()), float((states == FREE).mean())
    return Judged(float((m.state(points + SHIFT) == FREE).mean()), occupied, freed)


BASE = SensorConfig(sigma=(SIGMA_M,), min_depth=0.5, max_depth=REACH_M)


def learnt(seed: int = 1) -> NoReturnFit:
    """The chance of a missing return, from scans of known truth."""
    taken = scans(seed)
    true = np.concatenate([np.where(scan.true_m < REACH_M, scan.true_m, 0.0).reshape(-1) for scan in taken])
    return fit_no_return(true, np.concatenate([scan.no_return.reshape(-1) for scan in taken]))
