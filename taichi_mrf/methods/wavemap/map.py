"""Occupancy mapping by wavemap's measurement model: the baseline for lidars.

wavemap keeps its log-odds as wavelets in an octree and chooses, for each part of a scan, the coarsest cells
that keep within an error bound. Here each voxel is updated by itself, which is its model without that error.

The centre of each voxel that a beam can reach is compared with the beams nearest to it, and what they say
(model.py) is added to its log-odds. A voxel is one thread's work, so the result does not depend on any order.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config, SensorConfig, VolumeConfig
from taichi_mrf.config.sections import TimeConfig, WavemapConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.footprint import visible_box, window_around
from taichi_mrf.inference.keyframe import DepthImage, Footprint
from taichi_mrf.methods.brick_map import own_parameters, own_section
from taichi_mrf.methods.recursive import RecursiveMap, Scan
from taichi_mrf.methods.recursive_update import log_odds, updated
from taichi_mrf.methods.wavemap.beams import NEIGHBOURS, Beams, beams_of, upright_axes, visit_near
from taichi_mrf.methods.wavemap.model import BeamModel
from taichi_mrf.methods.wavemap.plug import METHOD, REACH_SIGMAS
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import (
    F32,
    I32,
    F32Array,
    I32Array,
    IVec3,
    IVec4,
    Mat3,
    Struct,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.window import Window

NO_BEAM = -1
"""Stands for a beam where there are fewer than NEIGHBOURS."""

WORTH_IT = 1.5
"""Least ratio of the widths of two searches for the narrower one to be tried first."""

AT_SENSOR_M = 1e-4
"""A point nearer to the sensor than this has no direction."""

HALF_DIAGONAL = 0.5 * math.sqrt(3.0)
"""From a cube's middle to its corner, for one that is 1 wide."""


@dataclass(frozen=True)
class Place(Bundle):
    """Pose of the sensor in a window, and which part of that is mapped."""

    centre: Vec3
    """The sensor, in voxels from the window's corner."""

    to_beams: Mat3
    """Turns a direction of the window, in voxels, into one of the beams' frame, in metres."""

    shape: IVec3
    """Size of the window in bricks."""

    lower: Vec3
    """Corners of the mapped part, in voxels from the window's corner."""

    upper: Vec3


@dataclass(frozen=True)
class BeamFootprint(Footprint):
    """A footprint with the beams that made it."""

    beams: Beams
    axes: NDArray[np.float64]


class BeamIntegrator:
    """Integrates scans."""

    def __init__(
        self, voxel_size: float, max_depth: float, config: WavemapConfig, volume: VolumeConfig
    ) -> None:
        self.voxel_size, self.max_depth, self.config, self.volume = voxel_size, max_depth, config, volume
        self.angle_rad = REACH_SIGMAS * config.angle_sigma
        self.behind_m = REACH_SIGMAS * config.range_sigma_at(voxel_size)
        self.model = BeamModel(
            config.range_sigma_at(voxel_size), config.angle_sigma, config.scaling_free,
            config.scaling_occupied, int(config.beams == "ray"),
        )  # fmt: skip

    def reach(self, image: DepthImage, T_world_camera: Pose) -> BeamFootprint:
        """The bricks that a scan's beams can reach. ``surface`` equals ``crossed``, so that all are
        allocated. Raises CapacityError if there is not enough memory."""
        beams = beams_of(
            image, behind_m=self.behind_m, max_depth=self.max_depth,
            max_range=self.config.max_range or math.inf,
        )  # fmt: skip
        axes, centre_m = upright_axes(image), T_world_camera[:3, 3]
        shortest = float(np.linalg.norm(image.camera.rays(), axis=-1).min())
        lower_m, upper_m = visible_box(
            image, T_world_camera, self.max_depth, end_sigmas=0.0, beyond_m=self.behind_m / shortest
        )
        lower_m, upper_m = np.minimum(lower_m, centre_m), np.maximum(upper_m, centre_m)
        # Voxels beside a beam are reached too.
        farthest_m = float(np.linalg.norm(np.abs([lower_m, upper_m] - centre_m).max(axis=0)))
        aside_m = self.voxel_size + self.angle_rad * farthest_m
        window = window_around(lower_m - aside_m, upper_m + aside_m, self.voxel_size, self.volume)
        if window is None or beams.number == 0:
            window, nothing = Window.covering(centre_m, centre_m, self.voxel_size), np.zeros(0, np.int32)
            return BeamFootprint(window, nothing, nothing, nothing, 1, beams, axes)
        place = self._place(window, T_world_camera, axes)
        chunks = np.zeros(window.cells // CHUNK**3, np.int32)
        marks = np.zeros(window.cells, np.int32)
        _mark_chunks(beams, place, self.angle_rad, chunks)
        _mark_bricks(beams, place, self.angle_rad, chunks, marks)
        crossed = np.flatnonzero(marks).astype(np.int32)
        what = f"a scan of {len(crossed) * VOXELS / 1e6:.3g} million voxels of {self.voxel_size:g} m"
        check_memory(4.0 * len(crossed) * VOXELS, what, self.volume.memory_limit_gb)
        return BeamFootprint(window, crossed, crossed, crossed, 1, beams, axes)

    def integrate(
        self, footprint: BeamFootprint, T_world_camera: Pose, slots: NDArray[np.int32], pool: BrickPool
    ) -> None:
        """Update the log-odds of the voxels that a scan's beams reach; ``slots`` (n,) are their bricks."""
        config = self.config
        most = NEIGHBOURS if config.beams == "neighbours" else 1
        place = self._place(footprint.window, T_world_camera, footprint.axes)
        _update(
            footprint.beams, self.model, place, self.angle_rad, most, footprint.crossed, slots, pool.belief,
            log_odds(config.lowest), log_odds(config.highest),
        )  # fmt: skip

    def _place(self, window: Window, T_world_camera: Pose, axes: NDArray[np.float64]) -> Place:
        to_beams = axes @ T_world_camera[:3, :3].T * self.voxel_size
        lower, upper = window.clip_box(self.volume.lower, self.volume.upper)
        centre = ti.Vector(window.to_voxels(T_world_camera[:3, 3]).tolist(), ti.f32)
        return Place(centre, ti.Matrix(to_beams.tolist(), ti.f32), window.shape_vector, lower, upper)


@ti.func
def _cell(number: I32, shape: IVec3) -> IVec3:
    """The cell of a row-major number in a box of cells."""
    return IVec3(number // (shape[1] * shape[2]), number // shape[2] % shape[1], number % shape[2])


@ti.func
def _is_reached(beams: Template, place: Template, cell: IVec3, size: Template, angle: F32) -> I32:
    """True if a beam reaches the centre of any voxel in a mapped cell of ``size`` voxels a side."""
    corner = ti.cast(cell, ti.f32) * size
    reached = 0
    if (corner + size - place.lower).min() > 0.0 and (place.upper - corner).min() > 0.0:
        offset = corner + 0.5 * size - place.centre
        way = place.to_beams @ offset
        distance = way.norm()
        radius = HALF_DIAGONAL * size * distance / ti.max(offset.norm(), 1e-6)  # in metres
        reached = 1
        if distance > 1.001 * radius and radius > 0.0:
            wide = ti.min(ti.asin(radius / distance) + angle, math.pi)
            reached = beams.reach(way / distance, wide, distance - radius)
    return reached


@kernel
def _mark_chunks(beams: Beams, place: Place, angle: F32, chunks: I32Array) -> None:
    """Set (chunks of the window) to 1 where a beam reaches the chunk."""
    for number in range(chunks.shape[0]):
        cell = _cell(number, place.shape // CHUNK)
        chunks[number] = _is_reached(beams, place, cell, CHUNK_VOXELS, angle)


@kernel
def _mark_bricks(beams: Beams, place: Place, angle: F32, chunks: I32Array, marks: I32Array) -> None:
    """Set (bricks of the window) to 1 where a beam reaches the brick; ``chunks`` as :func:`_mark_chunks` left
    them."""
    for number in range(marks.shape[0]):
        brick = _cell(number, place.shape)
        chunk, shape = brick // CHUNK, place.shape // CHUNK
        if chunks[(chunk[0] * shape[1] + chunk[1]) * shape[2] + chunk[2]] == 1:
            marks[number] = _is_reached(beams, place, brick, BRICK, angle)


@ti.dataclass
class _Nearest(Struct):
    """The beams nearest to a voxel's centre so far."""

    direction: Vec3  # of the centre, from the sensor
    chords: Vec4  # squares of the chords to the beams' directions, ascending; the largest that count for none
    beams: IVec4  # NO_BEAM for none


@ti.func
def _keep_nearest(nearest: Template, beams: Template, i: I32):
    """Put a beam in its place among the nearest."""
    chord, beam = (beams.direction(i) - nearest.direction).norm_sqr(), i
    if chord < nearest.chords[NEIGHBOURS - 1]:
        for k in ti.static(range(NEIGHBOURS)):
            if chord < nearest.chords[k]:
                other_chord, other = nearest.chords[k], nearest.beams[k]
                nearest.chords[k], nearest.beams[k] = chord, beam
                chord, beam = other_chord, other


@ti.func
def _last(nearest: Template, most: I32) -> F32:
    """The square of the chord to the last of the ``most`` nearest beams, 1 or NEIGHBOURS."""
    return nearest.chords[0] if most == 1 else nearest.chords[NEIGHBOURS - 1]


@ti.func
def _change(beams: Template, model: Template, way: Vec3, angle: F32, most: I32) -> F32:
    """Log-odds that the beams nearest to a point add; ``way`` goes there from the sensor, in metres."""
    change, distance = 0.0, way.norm()
    if distance > AT_SENSOR_M:
        nearest = _Nearest(way / distance, Vec4(angle * angle), IVec4(NO_BEAM))
        # The nearest are usually near, and a wide search takes long.
        first = beams.near if angle > WORTH_IT * beams.near else angle
        visit_near(beams, nearest.direction, first, _keep_nearest, nearest)
        if angle > first and _last(nearest, most) > first * first:
            nearest = _Nearest(nearest.direction, Vec4(angle * angle), IVec4(NO_BEAM))
            visit_near(beams, nearest.direction, angle, _keep_nearest, nearest)
        for k in ti.static(range(NEIGHBOURS)):
            beam = nearest.beams[k]
            if k < most and beam >= 0 and distance <= beams.beams[beam, 4]:
                off = _angle_of(nearest.chords[k])
                if off <= angle:
                    change += model.log_odds(distance, beams.beams[beam, 3], off)
    return change


@ti.func
def _angle_of(chord: F32) -> F32:
    """The angle between directions, at most 30 degrees, whose chord has this square: 2 asin(chord / 2)."""
    return ti.sqrt(chord) * (1.0 + chord * (1.0 / 24.0 + chord * (3.0 / 640.0)))


@kernel
def _update(
    beams: Beams, model: BeamModel, place: Place, angle: F32, most: I32, cells: I32Array, slots: I32Array,
    belief: F32Array, lowest: F32, highest: F32,
) -> None:  # fmt: skip
    """Add to each voxel's log-odds what the ``most`` beams nearest to its centre say, none further off than
    ``angle`` radians.

    ``cells`` (n) are bricks of the window, ``slots`` (n) their places in the pool, ``belief`` (pool * 512)
    log-odds, which stay within [lowest, highest].
    """
    # A row of a brick, because divisions are slow. Not more: Mesa's lavapipe ends the loops of a thread after
    # 65,535 rounds in all, and a voxel takes one for each beam that it looks at.
    for part in range(cells.shape[0] * BRICK * BRICK):
        in_brick = part % (BRICK * BRICK)
        brick = _cell(cells[part // (BRICK * BRICK)], place.shape)
        first = slots[part // (BRICK * BRICK)] * VOXELS + in_brick * BRICK
        for number in range(BRICK):
            voxel = brick * BRICK + IVec3(in_brick // BRICK, in_brick % BRICK, number)
            centre = ti.cast(voxel, ti.f32) + 0.5
            if (centre - place.lower).min() > 0.0 and (place.upper - centre).min() > 0.0:
                way = place.to_beams @ (centre - place.centre)
                change = _change(beams, model, way, angle, most)
                if change != 0.0:
                    belief[first + number] = updated(belief[first + number], change, lowest, highest)


class WavemapMap(RecursiveMap[BeamFootprint]):
    """A map that integrates scans by the measurement model of wavemap (Reijgwart et al., RSS 2023)."""

    METHOD: ClassVar[Method] = METHOD

    def __init__(
        self,
        voxel_size: float = 0.1,
        noise: NoiseModel | None = None,
        *,
        wavemap: WavemapConfig | None = None,
        volume: VolumeConfig | None = None,
        time: TimeConfig | None = None,
        min_depth: float = SensorConfig.min_depth,
        max_depth: float = SensorConfig.max_depth,
        **parameters: Any,
    ) -> None:
        """``parameters`` are fields of WavemapConfig, such as ``range_sigma=0.1`` or ``beams="nearest"``.

        ``noise`` is not used: the model has its own sigma of range, the same at all ranges. Rays beyond
        ``max_depth`` show free space up to there. Raises ConfigError for an unknown or impossible parameter.
        """
        section = own_section(wavemap, WavemapConfig, parameters, "wavemap", "WavemapMap")
        shared = own_parameters(voxel_size, volume, min_depth, max_depth, time)
        self._set_up(Config(**shared, wavemap=section), noise)

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        super()._set_up(config, noise)
        self._integrator = BeamIntegrator(
            self.voxel_size, self.sensor.max_depth, config.wavemap, config.volume
        )

    def _reach(self, image: DepthImage, T_world_camera: Pose) -> BeamFootprint:
        return self._integrator.reach(image, T_world_camera)

    def _integrate(self, scan: Scan[BeamFootprint]) -> None:
        self._integrator.integrate(scan.footprint, scan.T_world_camera, scan.slots, self._pool)

    @property
    def _scratch_bytes(self) -> int:
        return 0
