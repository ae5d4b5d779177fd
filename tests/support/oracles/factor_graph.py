"""Factor graphs of beams in float64 NumPy: energies by the definition, everything else by enumeration.

Shares no code with the kernels but the definition of parameters.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oracles.traversal import segments
from taichi_mrf.factor_graph.beams import Beams, Grid
from taichi_mrf.factor_graph.config import LaserConfig


@dataclass(frozen=True)
class Factor:
    """One beam: its cells' numbers in order, and its energy for each first occupied one, and for none."""

    cells: list[int]
    energies: list[float]


def cells_of(beams: Beams, f: int, grid: Grid) -> list[int]:
    """Numbers of the cells that beam f crosses."""
    reach = float(beams.range_m[f]) / grid.cell_size
    found, _, _ = segments(grid.to_cells(beams.origins[f]), beams.directions[f], 0.0, reach)
    return [int(n) for n in np.ravel_multi_index(tuple(found.T), grid.shape)]


def factor_of(beams: Beams, f: int, grid: Grid, config: LaserConfig) -> Factor:
    """Eqs. 25, 26 and 31."""
    cells = cells_of(beams, f, grid)
    if not beams.hit[f]:
        return Factor(cells, [config.energy_wrong] * len(cells) + [config.energy_explained])
    if config.sensor == "piecewise":
        earlier = [config.energy_wrong] * (len(cells) - 1)
        return Factor(cells, [*earlier, config.energy_explained, config.energy_free])
    centres = np.stack(np.unravel_index(cells, grid.shape), axis=1) + 0.5
    distance = (centres - grid.to_cells(beams.origins[f])) @ beams.directions[f] * grid.cell_size
    deviation = (distance - float(beams.range_m[f])) / config.sigma
    gaussian = 0.5 * deviation**2 + math.log(config.sigma * math.sqrt(2 * math.pi))
    return Factor(cells, [*np.minimum(gaussian, config.energy_wrong), config.energy_free])


def factors_of(beams: Beams, grid: Grid, config: LaserConfig) -> list[Factor]:
    return [factor_of(beams, f, grid, config) for f in range(len(beams))]


def energy(factors: list[Factor], labels: NDArray) -> float:
    """Of a labelling of all cells."""
    total = 0.0
    for factor in factors:
        occupied = [k for k, cell in enumerate(factor.cells) if labels[cell]]
        total += factor.energies[occupied[0] if occupied else len(factor.cells)]
    return total


@dataclass(frozen=True)
class Enumeration:
    """All labellings of the cells that any factor has."""

    cells: list[int]
    labellings: NDArray[np.uint8]
    energies: NDArray[np.float64]

    @property
    def marginals(self) -> NDArray[np.float64]:
        """Probability of occupied of each of ``cells``."""
        weights = np.exp(self.energies.min() - self.energies)
        return weights @ self.labellings / weights.sum()

    @property
    def differences(self) -> NDArray[np.float64]:
        """Least energy with each of ``cells`` occupied, less the least with it free."""
        return np.array(
            [
                self.energies[column == 1].min() - self.energies[column == 0].min()
                for column in self.labellings.T
            ]
        )


def enumerate_all(factors: list[Factor], size: int) -> Enumeration:
    """``size`` is the number of the grid's cells."""
    cells = sorted({cell for factor in factors for cell in factor.cells})
    labellings = np.array(list(itertools.product((0, 1), repeat=len(cells))), np.uint8)
    everywhere = np.zeros((len(labellings), size), np.uint8)
    everywhere[:, cells] = labellings
    return Enumeration(cells, labellings, np.array([energy(factors, row) for row in everywhere]))


def is_tree(factors: list[Factor]) -> bool:
    """True if the graph of cells and factors has no cycle: union-find over its edges."""
    parent: dict[tuple[str, int], tuple[str, int]] = {}

    def root(node: tuple[str, int]) -> tuple[str, int]:
        while parent.setdefault(node, node) != node:
            node = parent[node]
        return node

    for number, factor in enumerate(factors):
        for cell in factor.cells:
            a, b = root(("factor", number)), root(("cell", cell))
            if a == b:
                return False
            parent[a] = b
    return True
