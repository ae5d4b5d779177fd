"""Forward sensor models (section VI), and the energy of a labelling by which every method is judged.

Energies are negative log-likelihoods. All models depend on nothing but the first occupied cell of a beam:

    piecewise (eq. 26)   its last one: energy_explained; an earlier one: energy_wrong; none: energy_free
    Gaussian (eq. 25)    at distance d from the origin: -log N(d; z, sigma), at most energy_wrong; none:
                         energy_free, which is the otherwise of eq. 27
    table                what the graph's table holds for each of its cells, and for none

and with the first two a beam without a return is explained if all its cells are free, and wrong otherwise.
The patterns of section VI-B, with free nodes behind the first occupied one, are therefore "cell k is the
first occupied one" and "no cell is occupied", for all models, and every message and every slave is found in
one pass there and one back (inference/first_occupied.py).
"""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.kernels.types import (
    F32,
    I32,
    F32Array2,
    I32Array,
    I64Array,
    IVec3,
    Struct,
    Template,
    Vec3,
    Vec5,
)

UNITS = 4096.0
"""Energies, messages and their sums are counted in integers of 1 / UNITS: they are the same in any order."""

EXPLAINED, FREE, WRONG, PRECISION, OFFSET = range(5)
"""Places in the vector of a sensor model's numbers."""

PIECEWISE, GAUSSIAN, TABLE = range(3)
"""Sensor models, for kernels that are compiled for one of them."""

NEARLY_BEST = 4.5
"""By a table, a beam is explained if its energy is within this of its least one: three sigma."""


@ti.dataclass
class Beam(Struct):
    """A factor: its cells are edges ``begin`` to ``begin + steps - 1``. Lengths are in cell sizes."""

    number: I32
    begin: I32
    steps: I32
    hit: I32
    origin: Vec3
    direction: Vec3
    reach: F32


def sensor_vector(graph: FactorGraph, config: LaserConfig) -> "ti.Vector":
    """The numbers of a sensor model: three energies, the Gaussian's precision per squared cell size, halved,
    and its energy at the measured range."""
    precision = 0.5 * (graph.grid.cell_size / config.sigma) ** 2
    offset = math.log(config.sigma * math.sqrt(2 * math.pi))
    energies = (config.energy_explained, config.energy_free, config.energy_wrong)
    return ti.Vector([*energies, precision, offset], ti.f32)


def model_kind(graph: FactorGraph, config: LaserConfig) -> int:
    """Which of the models: the graph's table if it has one, else as configured."""
    if graph.has_table:
        return TABLE
    return GAUSSIAN if config.sensor == "gaussian" else PIECEWISE


@ti.func
def beam_of(f: I32, begins: Template, hits: Template, model: Template, kind: Template) -> Beam:
    """Factor f; its geometry is only read for the Gaussian model."""
    origin, direction, reach = Vec3(0.0), Vec3(0.0), 0.0
    if ti.static(kind == GAUSSIAN):
        origin = Vec3(model[f, 0], model[f, 1], model[f, 2])
        direction = Vec3(model[f, 3], model[f, 4], model[f, 5])
        reach = model[f, 6]
    return Beam(f, begins[f], begins[f + 1] - begins[f], hits[f], origin, direction, reach)


@ti.func
def energy_of_first(
    beam: Beam, step: I32, cell: I32, model: Template, sensor: Vec5, shape: IVec3, kind: Template
) -> F32:
    """Energy of a beam whose first occupied cell is its ``step``-th, which has the number ``cell``."""
    energy = sensor[WRONG]
    if ti.static(kind == TABLE):
        energy = model[beam.begin + beam.number + step, 0]
    elif beam.hit == 1:
        if ti.static(kind == GAUSSIAN):
            layer, row, column = cell % shape[2], cell // shape[2] % shape[1], cell // shape[2] // shape[1]
            centre = Vec3(column + 0.5, row + 0.5, layer + 0.5)
            deviation = (centre - beam.origin).dot(beam.direction) - beam.reach
            energy = ti.min(energy, sensor[OFFSET] + sensor[PRECISION] * deviation * deviation)
        elif step == beam.steps - 1:
            energy = sensor[EXPLAINED]
    return energy


@ti.func
def energy_of_none(beam: Beam, model: Template, sensor: Vec5, kind: Template) -> F32:
    """Energy of a beam whose cells are all free."""
    energy = sensor[FREE] if beam.hit == 1 else sensor[EXPLAINED]
    if ti.static(kind == TABLE):
        energy = model[beam.begin + beam.number + beam.steps, 0]
    return energy


@ti.func
def to_units(value: F32) -> ti.i64:
    """The nearest whole number of 1 / UNITS."""
    return ti.cast(ti.round(value * UNITS), ti.i64)


@ti.func
def first_occupied(beam: Beam, cells: Template, labels: Template) -> I32:
    """The step of the first occupied cell, or the number of steps where all are free."""
    step = 0
    while step < beam.steps and labels[cells[beam.begin + step]] == 0:
        step += 1
    return step


@ti.func
def energy_of(
    beam: Beam, first: I32, cells: Template, model: Template, sensor: Vec5, shape: IVec3, kind: Template
) -> F32:
    """Energy of a beam whose first occupied cell is step ``first``, or of all free at the number of steps."""
    energy = energy_of_none(beam, model, sensor, kind)
    if first < beam.steps:
        energy = energy_of_first(beam, first, cells[beam.begin + first], model, sensor, shape, kind)
    return energy


@ti.func
def is_explained(
    beam: Beam, first: I32, energy: F32, cells: Template, model: Template, sensor: Vec5, shape: IVec3,
    kind: Template,
) -> I32:  # fmt: skip
    """Whether ``first`` is what the beam's measurement asks for."""
    explained = ti.cast(first == beam.steps - beam.hit, ti.i32)
    if ti.static(kind == TABLE):
        least = energy
        for other in range(beam.steps + 1):
            least = ti.min(least, energy_of(beam, other, cells, model, sensor, shape, kind))
        explained = ti.cast(energy <= least + NEARLY_BEST, ti.i32)
    return explained


@ti.kernel
def _judge(
    begins: I32Array, cells: I32Array, hits: I32Array, model: F32Array2, shape: IVec3, sensor: Vec5,
    labels: I32Array, sums: I64Array, kind: Template,
):  # fmt: skip
    """Add up the energies of all beams, in units, and count the explained ones."""
    for f in range(begins.shape[0] - 1):
        beam = beam_of(f, begins, hits, model, kind)
        first = first_occupied(beam, cells, labels)
        energy = energy_of(beam, first, cells, model, sensor, shape, kind)
        ti.atomic_add(sums[0], to_units(energy))
        if is_explained(beam, first, energy, cells, model, sensor, shape, kind):
            ti.atomic_add(sums[1], ti.cast(1, ti.i64))


def judged(graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8]) -> tuple[float, float]:
    """(energy, share of beams explained) of a labelling, (cells,), 1 for occupied.

    A beam is explained if its last cell is its first occupied one, or without a return if all are free; by
    a table, if it is within NEARLY_BEST of its least energy.
    """
    sums = np.zeros(2, np.int64)
    if graph.beams:
        _judge(
            *tables(graph), sensor_vector(graph, config), np.ascontiguousarray(labels, np.int32), sums,
            model_kind(graph, config),
        )  # fmt: skip
    return float(sums[0]) / UNITS, float(sums[1]) / max(1, graph.beams)


def energy(graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8]) -> float:
    """The energy of a labelling, (cells,), 1 for occupied: the one judge of all methods."""
    return judged(graph, config, labels)[0]


def tables(graph: FactorGraph) -> "tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray, ti.Ndarray, ti.Vector]":
    """What kernels over beams read: where each one's cells begin, cells, hits, geometry or table, and the
    grid's shape."""
    return graph.begins, graph.cells, graph.hits, graph.model, ti.Vector(graph.grid.shape, ti.i32)
