"""Coverage of the view frustum by the samples, and sentences that name the gaps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.samples import Cells

ENOUGH = 0.5
"""A region counts as covered at some depth if this share of its patches has enough samples there."""

SOMEWHERE = 0.1
"""A depth counts as covered if this share of all patches has enough samples there."""

GAP_BINS = 3
"""Shorter gaps in one part of the image are not reported: the polynomials bridge them."""

_ROWS = ("top", "middle", "bottom")
_COLUMNS = ("left", "centre", "right")


@dataclass(frozen=True)
class Coverage:
    """Cells with enough samples, (patches, bins), of a sensor's working range."""

    cells: Cells
    covered: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Covered cells of all cells, 0 to 1."""
        return float(self.covered.mean())

    def depth_range(self) -> tuple[float, float]:
        """Nearest and furthest depth in metres at which at least SOMEWHERE of the patches are covered;
        if there is none, at which any patch is."""
        share = self.covered.mean(axis=0)
        bins = np.flatnonzero(share >= SOMEWHERE)
        if len(bins) == 0:
            bins = np.flatnonzero(share > 0)
        return float(self.cells.edges[bins[0]]), float(self.cells.edges[bins[-1] + 1])

    def in_words(self) -> list[str]:
        """Sentences that name where data are missing, or one that all is covered."""
        missing = self._by_region() < ENOUGH
        everywhere = np.asarray(missing.all(axis=0))
        sentences = []
        if everywhere.any():
            nowhere = self._ranges(everywhere, besides=np.zeros_like(everywhere), least_bins=1)
            sentences.append(f"Not covered in the whole image: {nowhere}.")
        places: dict[str, list[str]] = {}
        for region, lacking in enumerate(missing):
            ranges = self._ranges(lacking, besides=everywhere)
            if ranges:
                places.setdefault(ranges, []).append(_region_name(region))
        for ranges, names in places.items():
            sentences.append(f"Not covered at the {_listed(names)}: {ranges}.")
        return sentences or ["All of the view is covered."]

    def _by_region(self) -> NDArray[np.float64]:
        """Share of covered patches in each ninth of the image, (9, bins)."""
        shape = (self.cells.rows, self.cells.columns)
        grid = self.covered.reshape(*shape, -1)
        rows, columns = (np.array_split(np.arange(count), 3) for count in shape)
        # An image of fewer than three patches along a side has empty ninths, which count as covered.
        return np.stack(
            [
                grid[np.ix_(r, c)].mean(axis=(0, 1)) if len(r) and len(c) else np.ones(self.cells.bins)
                for r in rows
                for c in columns
            ]
        )

    def _ranges(self, bins: NDArray[np.bool_], besides: NDArray[np.bool_], least_bins: int = GAP_BINS) -> str:
        """Runs of bins as depths: "nearer than 0.5 m, 1.2 to 1.6 m, beyond 3 m"; only those with at least
        ``least_bins`` that are not in ``besides``."""
        steps = np.flatnonzero(np.diff(np.concatenate([[0], bins.astype(np.int8), [0]])))
        texts = []
        for first, end in steps.reshape(-1, 2):
            if (~besides[first:end]).sum() < least_bins:
                continue
            near, far = self.cells.edges[first], self.cells.edges[end]
            if first == 0 and end == len(bins):
                return "at any depth"
            if first == 0:
                texts.append(f"nearer than {far:.4g} m")
            elif end == len(bins):
                texts.append(f"beyond {near:.4g} m")
            else:
                texts.append(f"{near:.4g} to {far:.4g} m")
        return ", ".join(texts)


def _region_name(region: int) -> str:
    row, column = _ROWS[region // 3], _COLUMNS[region % 3]
    if row == "middle":
        return column
    return row if column == "centre" else f"{row} {column}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
