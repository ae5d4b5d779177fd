"""The layers of a map: named values of each voxel, and the one table that says what they are, and how pixels
make them.

A layer that pixels feed (colours; ``from_pixels``) is an entry here and the visitor that it names: what a
ray's posterior adds to a voxel's sums (inference/pixel_pass.py). Adding and removing keyframes, freezing,
saving, loading, windows, chunks, readings of other times and exports (.ply points, .npz, .zarr) loop over the
table, and so do the page's colourings and the check of the images beside depth (``add_keyframe(images=...)``,
``Frame.images``).

A layer of another source is an entry, and a value where the source is read (export/chunk_blocks.py for maps
in memory).
"""

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS, by_chunk, grid_keys, split_bricks

Chunk = tuple[int, int, int]
"""Coordinates of a chunk."""


@dataclass(frozen=True)
class OnPage:
    """Display of a layer that pixels feed: the name of its ``coloring`` on the page, its ``help``, and the
    ``caption`` of its legend with a ``key``, RGB by meaning. ``painted`` is the module and the name of a
    function from values (n, 512, ...) to RGB (n, 512, 3), colors.NO_COLOR where nothing is known."""

    coloring: str
    help: str
    caption: str
    painted: str
    key: tuple[tuple[str, tuple[int, int, int]], ...] = ()


@dataclass(frozen=True)
class FromPixels:
    """Derivation of a layer from an image beside depth.

    ``image`` is the argument of ``add_keyframe``, or the name among its ``images``; ``channels`` uint8 of a
    pixel, all 0 where it says nothing. ``visitor`` is the module and the class of its PixelVisitor, loaded
    when a map is first asked for the layer. A voxel's sums are int64 ``words``, each of which holds two
    numbers; ``stored`` and the words' names are those of what frozen keyframes gave, in files. ``page`` is
    its display. No two layers have the same image, ``stored`` or colouring.
    """

    image: str
    channels: int
    visitor: str
    stored: str
    words: tuple[str, ...]
    page: OnPage


def imported(place: str) -> Any:
    """The object that a module and a name stand for, imported now."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True)
class Layer:
    """The ``dtype`` of a voxel's values, how many there are (``width``), the value that is ``missing``
    where nothing is known, and how pixels make it, if they do."""

    dtype: str
    width: int
    missing: float
    about: str
    from_pixels: FromPixels | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one voxel's values: none for a width of 1."""
        return (self.width,) if self.width > 1 else ()

    @property
    def nbytes(self) -> int:
        """Bytes of one voxel's values."""
        return self.width * np.dtype(self.dtype).itemsize

    @property
    def chunk_shape(self) -> tuple[int, ...]:
        """The shape of a chunk's values."""
        return (CHUNK_VOXELS, CHUNK_VOXELS, CHUNK_VOXELS, *self.shape)


LOG_ODDS, COLORS, SURFACE, FIRST = "log_odds", "colors", "surface", "first_surface"

_PHOTO = OnPage(
    "photo", "what colours cameras saw.", "what cameras saw; grey where none did",
    "taichi_mrf.queries.colored:painted",
)  # fmt: skip
_OF_COLOR_IMAGES = FromPixels(
    "color", 3, "taichi_mrf.inference.voxel_colors:ColorVisitor", "frozen_color", ("rg", "bw"), _PHOTO
)

LAYERS = {
    LOG_ODDS: Layer("float32", 1, np.nan, "log-odds of being occupied"),
    COLORS: Layer("uint8", 4, 0, "red, green, blue, and how much was seen", _OF_COLOR_IMAGES),
    SURFACE: Layer("float32", 3, 0, "weight, and distance and excess times weight (DistanceField)"),
    FIRST: Layer("uint8", 1, 0, "what rays say beyond the marginal (calls.py)"),
}
"""Every map has log-odds; the others are there if it has them."""


def pixel_layers() -> dict[str, FromPixels]:
    """The layers that pixels feed. Raises ConfigError if two share an image, ``stored`` or a colouring."""
    made = {name: layer.from_pixels for name, layer in LAYERS.items() if layer.from_pixels is not None}
    for field in ("image", "stored", "page.coloring"):
        first: dict[str, str] = {}
        for name, each in made.items():
            value = attrgetter(field)(each)
            if (other := first.setdefault(value, name)) != name:
                raise ConfigError(
                    f"layers {other} and {name}: both have {field} {value!r}; each needs its own"
                )
    return made


@dataclass(frozen=True)
class BrickValues:
    """Values of a layer: ``bricks`` (n, 3), each once, and ``values`` (n, 512) of their voxels, with a last
    axis for a layer of more than one."""

    bricks: NDArray[np.int32]
    values: NDArray

    @staticmethod
    def of_chunk(chunk: Chunk, block: NDArray) -> "BrickValues":
        """Those of a chunk's bricks, from its block (64, 64, 64), with a last axis for a layer of more."""
        bricks = np.indices((CHUNK,) * 3).reshape(3, -1).T + np.array(chunk) * CHUNK
        layers = block.reshape(*block.shape[:3], -1)
        values = np.stack([split_bricks(layers[..., i]) for i in range(layers.shape[3])], axis=-1)
        return BrickValues(bricks.astype(np.int32), values.reshape(*values.shape[:2], *block.shape[3:]))

    def chosen(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "BrickValues":
        """Those of some bricks: a mask (n,), or numbers of rows."""
        return BrickValues(self.bricks[rows], self.values[rows])

    def in_chunks(self, chunks: NDArray[np.int32]) -> "BrickValues":
        """Those of the bricks in some chunks, (n, 3)."""
        return self.chosen(np.isin(grid_keys(self.bricks // CHUNK), grid_keys(chunks)))


Layers = Mapping[str, BrickValues]
"""Values by the names of their layers."""


def known_log_odds(log_odds: NDArray[np.float32], prior_log_odds: float) -> NDArray[np.float32]:
    """Log-odds as a layer: NaN for voxels that hold the prior, which are unknown."""
    return np.where(log_odds == np.float32(prior_log_odds), np.float32(np.nan), log_odds)


def chunk_blocks(layer: Layer, found: BrickValues) -> Iterator[tuple[Chunk, NDArray]]:
    """The blocks (64, 64, 64) of the chunks that some bricks lie in, with a last axis for a layer of more
    than one value."""
    for chunk, rows in by_chunk(found.bricks):
        block = np.full((CHUNK, BRICK, CHUNK, BRICK, CHUNK, BRICK, *layer.shape), layer.missing, layer.dtype)
        x, y, z = (found.bricks[rows] - np.array(chunk) * CHUNK).T
        block[x, :, y, :, z, :] = found.values[rows].reshape(-1, BRICK, BRICK, BRICK, *layer.shape)
        yield chunk, block.reshape(layer.chunk_shape)


def of_voxels(bricks: NDArray[np.int32], numbers: NDArray[np.int32], values: NDArray) -> BrickValues:
    """Values of some voxels, (n, ...), which are given by their bricks (n, 3) and their ``numbers`` in these;
    0 for the other voxels of the bricks."""
    keys, first, row = np.unique(grid_keys(bricks), return_index=True, return_inverse=True)
    dense = np.zeros((len(keys), VOXELS, *values.shape[1:]), values.dtype)
    dense[row.reshape(-1), numbers] = values
    return BrickValues(bricks[first], dense)
