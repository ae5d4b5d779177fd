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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.factor_graph.config import LaserConfig
from taichi_mrf.factor_graph.graph import FactorGraph
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import (
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
    """The sensor model: the graph's table if it has one, else the configured one."""
    if graph.has_table:
        return TABLE
    return GAUSSIAN if config.sensor == "gaussian" else PIECEWISE


@dataclass(frozen=True)
class BeamGraph(Bundle):
    """A factor graph as kernels over beams read it, with the sensor model of its factors."""

    begins: I32Array
    """(beams + 1): the edges of beam f are ``begins[f]`` to ``begins[f + 1] - 1``."""

    cells: I32Array
    """(edges): the cell of each edge."""

    hits: I32Array
    """(beams): 1 where something returned."""

    model: F32Array2
    """(beams, 7): each beam's origin, direction and range in cell sizes; or (edges + beams, 1): its energies
    (FactorGraph.model)."""

    shape: IVec3
    """The grid's size in cells."""

    sensor: Vec5
    """The sensor model's numbers (sensor_vector)."""

    kind: Template
    """PIECEWISE, GAUSSIAN or TABLE."""

    @ti.func
    def beam(self, f: I32):
        """Factor f; its geometry is only read for the Gaussian model."""
        origin, direction, reach = Vec3(0.0), Vec3(0.0), 0.0
        if ti.static(self.kind == GAUSSIAN):
            origin = Vec3(self.model[f, 0], self.model[f, 1], self.model[f, 2])
            direction = Vec3(self.model[f, 3], self.model[f, 4], self.model[f, 5])
            reach = self.model[f, 6]
        begin = self.begins[f]
        return Beam(f, begin, self.begins[f + 1] - begin, self.hits[f], origin, direction, reach)

    @ti.func
    def energy_of_first(self, beam: Beam, step: I32, cell: I32):
        """Energy of a beam whose first occupied cell is its ``step``-th, which has the number ``cell``."""
        energy = self.sensor[WRONG]
        if ti.static(self.kind == TABLE):
            energy = self.model[beam.begin + beam.number + step, 0]
        elif beam.hit == 1:
            if ti.static(self.kind == GAUSSIAN):
                rows, layers = self.shape[1], self.shape[2]
                layer, row, column = cell % layers, cell // layers % rows, cell // layers // rows
                centre = Vec3(column + 0.5, row + 0.5, layer + 0.5)
                deviation = (centre - beam.origin).dot(beam.direction) - beam.reach
                energy = ti.min(energy, self.sensor[OFFSET] + self.sensor[PRECISION] * deviation * deviation)
            elif step == beam.steps - 1:
                energy = self.sensor[EXPLAINED]
        return energy

    @ti.func
    def energy_of_none(self, beam: Beam):
        """Energy of a beam whose cells are all free."""
        energy = self.sensor[FREE] if beam.hit == 1 else self.sensor[EXPLAINED]
        if ti.static(self.kind == TABLE):
            energy = self.model[beam.begin + beam.number + beam.steps, 0]
        return energy

    @ti.func
    def energy_of(self, beam: Beam, first: I32):
        """Energy of a beam whose first occupied cell is step ``first``, or of all free at the number of
        steps."""
        energy = self.energy_of_none(beam)
        if first < beam.steps:
            energy = self.energy_of_first(beam, first, self.cells[beam.begin + first])
        return energy

    @ti.func
    def first_occupied(self, beam: Beam, labels: Template):
        """The step of the first occupied cell, or the number of steps where all are free."""
        step = 0
        while step < beam.steps and labels[self.cells[beam.begin + step]] == 0:
            step += 1
        return step

    @ti.func
    def is_explained(self, beam: Beam, first: I32, energy: F32):
        """True if ``first`` is what the beam's measurement asks for."""
        explained = ti.cast(first == beam.steps - beam.hit, ti.i32)
        if ti.static(self.kind == TABLE):
            least = energy
            for other in range(beam.steps + 1):
                least = ti.min(least, self.energy_of(beam, other))
            explained = ti.cast(energy <= least + NEARLY_BEST, ti.i32)
        return explained


def beam_graph(graph: FactorGraph, config: LaserConfig) -> BeamGraph:
    """A graph as kernels take it."""
    shape = ti.Vector(graph.grid.shape, ti.i32)
    sensor, kind = sensor_vector(graph, config), model_kind(graph, config)
    return BeamGraph(graph.begins, graph.cells, graph.hits, graph.model, shape, sensor, kind)


@ti.func
def to_units(value: F32) -> ti.i64:
    """The nearest whole number of 1 / UNITS."""
    return ti.cast(ti.round(value * UNITS), ti.i64)


@kernel
def _judge(graph: BeamGraph, labels: I32Array, sums: I64Array) -> None:
    """Add up the energies of all beams, in units, in ``sums[0]``, and count the explained ones in
    ``sums[1]``.

    ``labels`` (cells) is 1 for occupied.
    """
    for f in range(graph.begins.shape[0] - 1):
        beam = graph.beam(f)
        first = graph.first_occupied(beam, labels)
        energy = graph.energy_of(beam, first)
        ti.atomic_add(sums[0], to_units(energy))
        if graph.is_explained(beam, first, energy):
            ti.atomic_add(sums[1], ti.cast(1, ti.i64))


def judged(graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8]) -> tuple[float, float]:
    """(energy, share of beams explained) of a labelling, (cells,), 1 for occupied.

    A beam is explained if its last cell is its first occupied one, or without a return if all are free; by
    a table, if it is within NEARLY_BEST of its least energy.
    """
    sums = np.zeros(2, np.int64)
    if graph.beams:
        _judge(beam_graph(graph, config), np.ascontiguousarray(labels, np.int32), sums)
    return float(sums[0]) / UNITS, float(sums[1]) / max(1, graph.beams)


def energy(graph: FactorGraph, config: LaserConfig, labels: NDArray[np.uint8]) -> float:
    """The energy of a labelling, (cells,), 1 for occupied: the one judge of all methods."""
    return judged(graph, config, labels)[0]
