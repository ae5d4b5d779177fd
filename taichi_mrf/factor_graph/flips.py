"""Flipping one cell: what it costs (eq. 16) and what it leaves behind, by the beams that cross it alone.

For a labelling, the first occupied step of every beam is kept, which is all that its energy depends on. A
flip before it or at it changes a beam's energy, and only freeing the first one itself makes it look further
along the beam. Several labellings may be kept at once, one behind the other: a labelling's cells begin at
``base`` and its beams at ``beam_base``.
"""

from taichi_mrf.factor_graph.potentials import to_units
from taichi_mrf.kernels.types import I32, I32Array, Template
from taichi_mrf.system.compiler import ti

SPREAD = 512
"""Taichi gives a CPU thread no fewer iterations of a loop at a time: one long task stands for that many."""


@ti.kernel
def find_firsts(
    begins: I32Array, cells: I32Array, labels: I32Array, firsts: I32Array, chains: I32, size: I32
):
    """Each beam's first occupied step, for each chain.

    ``begins`` (beams + 1) and ``cells`` (edges) are those of the graph, ``labels`` (chains * size) 1 for
    occupied; ``firsts`` (chains * beams) receives the steps.
    """
    beams = begins.shape[0] - 1
    for i in range(chains * beams):
        chain, f = i // beams, i % beams
        first, steps = 0, begins[f + 1] - begins[f]
        while first < steps and labels[chain * size + cells[begins[f] + first]] == 0:
            first += 1
        firsts[i] = first


@ti.func
def after_flip(
    first: I32, step: I32, occupied: I32, begin: I32, steps: I32, cells: Template, labels: Template, base: I32
) -> I32:
    """A beam's first occupied step once the cell at ``step``, now ``occupied`` or not, is flipped.

    A chain's labels begin at ``base``.
    """
    new: ti.i32 = first
    if occupied == 0:
        new = ti.min(first, step)
    elif step == first:
        new = step + 1
        while new < steps and labels[base + cells[begin + new]] == 0:
            new += 1
    return new


@ti.func
def flip_change(
    cell: I32, labels: Template, base: I32, firsts: Template, beam_base: I32, graph: Template, lists: Template
):
    """Change of the energy by flipping ``cell``, in units: a sum of integers, so the list's order is free.
    ``graph`` is a BeamGraph, ``lists`` are its CellLists."""
    occupied = labels[base + cell]
    change = ti.cast(0, ti.i64)
    for i in range(lists.begins[cell], lists.begins[cell + 1]):
        f = lists.beams[i]
        step = ti.cast(lists.steps[i], ti.i32)
        first = firsts[beam_base + f]
        if step <= first:
            beam = graph.beam(f)
            new = after_flip(first, step, occupied, beam.begin, beam.steps, graph.cells, labels, base)
            change += to_units(graph.energy_of(beam, new))
            change -= to_units(graph.energy_of(beam, first))
    return change


@ti.func
def flip(
    cell: I32, labels: Template, base: I32, firsts: Template, beam_base: I32, graph: Template, lists: Template
):
    """Flip ``cell``, and renew the first occupied steps of its beams."""
    occupied = labels[base + cell]
    for i in range(lists.begins[cell], lists.begins[cell + 1]):
        f = lists.beams[i]
        step = ti.cast(lists.steps[i], ti.i32)
        first = firsts[beam_base + f]
        if step <= first:
            begin, end = graph.begins[f], graph.begins[f + 1]
            firsts[beam_base + f] = after_flip(
                first, step, occupied, begin, end - begin, graph.cells, labels, base
            )
    labels[base + cell] = 1 - occupied
