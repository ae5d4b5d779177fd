"""Many maps on one picture, each seen from above."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.figures import new_figure
from taichi_mrf.system.atomic import atomic_path

MOST_TILES = 64
"""More than that could not be made out on one picture."""

_COLUMNS = 4
_TILE_IN = 4.2
_DPI = 120
_LETTERS = 44
"""That fit beside each other on a tile."""

_LINES = 10
"""Of text that fit below each other on a tile; the first ones say what went wrong."""


@dataclass(frozen=True)
class Tile:
    """One map: its name, a line of figures, and its picture from above, or why there is none."""

    name: str
    caption: str
    picture: Path | None
    instead: str = ""


def write_contact_sheet(path: Path, tiles: Sequence[Tile]) -> None:
    """Write the first MOST_TILES tiles as a PNG, row by row, and note how many are left out. Raises
    MapFileError."""
    shown = tiles[:MOST_TILES]
    columns = max(1, min(_COLUMNS, math.ceil(math.sqrt(len(shown)))))
    rows = max(1, math.ceil(len(shown) / columns))
    figure = new_figure(columns * _TILE_IN, rows * (_TILE_IN * 0.82 + 0.5) + 0.3)
    for number, axes in enumerate(figure.subplots(rows, columns, squeeze=False).flat):
        axes.set_axis_off()
        if number >= len(shown):
            continue
        tile = shown[number]
        name = tile.name if len(tile.name) <= _LETTERS else f"{tile.name[: _LETTERS - 3]}..."
        axes.set_title(f"{name}\n{tile.caption}", fontsize=10)
        picture = None if tile.picture is None else _read(tile.picture)
        if picture is None:
            text = textwrap.fill(tile.instead or "no picture", _LETTERS, max_lines=_LINES, placeholder=" ...")
            axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, fontsize=9)
        else:
            axes.imshow(picture)
    if len(shown) < len(tiles):
        figure.suptitle(f"the first {len(shown)} of {len(tiles)} maps")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI, pil_kwargs={"compress_level": 2})


def _read(path: Path) -> NDArray[np.uint8] | None:
    """The picture, made as small as its tile; None if it cannot be read."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        return None
    scale = min(1.0, _TILE_IN * _DPI / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), np.uint8)
