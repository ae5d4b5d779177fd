"""The colourings of voxels and of the measured surface, their scales and legends. No page is needed to import
them.

A colouring is one entry of :data:`COLORINGS`: the page offers it where the map has its data, makes its legend
from the numbers that are there, and shows its help. Layers that pixels feed bring theirs (voxels/layers.py).
"""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.messages import LOG_ODDS_STEP
from taichi_mrf.viewer.scene.voxel_store import Shown
from taichi_mrf.viewer.scene.widgets import image_html
from taichi_mrf.voxels.colors import NO_COLOR
from taichi_mrf.voxels.layers import COLORS, OnPage, pixel_layers

Floats = NDArray[np.floating]
Ends = tuple[float, float]
Need = Literal["", "counts", "colors"]
"""Data of voxels that are sent when :class:`messages.Watch` asks for them."""

DYNAMIC_COLOR = (255, 30, 20)
"""The colour of dynamic voxels, which no scale has."""

CHANGE_COLORS = {"appeared": (40, 200, 90), "left": (255, 170, 30)}
"""Colours of the boxes around what appeared and what left."""

SPACE_COLORS = {"free": (70, 130, 200), "occupied": (253, 200, 36)}
"""Colours in a cut."""

CHANCES: dict[str, tuple[float, tuple[int, int, int]]] = {
    "1 in 1000": (-6.907, (125, 130, 140)),
    "1 in 10": (-2.197, (196, 178, 160)),
    "1 in 2": (0.0, (240, 110, 40)),
    "9 in 10": (2.197, (247, 190, 95)),
    "99 in 100": (4.595, (150, 200, 180)),
    "999 in 1000": (6.907, (60, 140, 190)),
}
"""Chances that a voxel is occupied, as log-odds, and their colours; those between are blended."""

_MOST_RATIO = 1000.0
"""Between the ends of a logarithmic scale."""
_DARKENED = (0.75, 0.62, 1.0)
"""Brightness of surfaces perpendicular to x, y and z."""

_ACROSS = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1)
_MEAN = _ACROSS @ _DARKENED / np.maximum(_ACROSS.sum(axis=1), 1)
_SHADES = np.rint(256 * np.where(_ACROSS.any(axis=1), _MEAN, sum(_DARKENED) / 3)).astype(np.uint16)


@cache
def ramp(name: str, first: int = 0) -> NDArray[np.uint8]:
    """The 256 colours (256, 3) of one of matplotlib's colour maps, from its ``first`` of 256 on."""
    from matplotlib import colormaps

    found: NDArray[np.uint8] = colormaps[name](np.linspace(first, 255, 256).astype(int), bytes=True)[:, :3]
    return np.ascontiguousarray(found)


def spread(numbers: Floats, heights_m: Ends) -> Ends:
    """Ends between which nearly all numbers lie, to one digit, so that a map that grows seldom moves them."""
    low, high = np.quantile(numbers, [0.02, 0.98]) if len(numbers) else (0.1, 1.0)
    low, high = _one_digit(low, np.floor), _one_digit(high, np.ceil)
    return low, high if high > low else low + max(abs(low), 1.0)


def _one_digit(number: float, rounded: Callable[[float], float]) -> float:
    power = 10.0 ** np.floor(np.log10(max(abs(number), 1e-12)))
    return float(f"{rounded(round(number / power, 9)) * power:.1g}")


@dataclass(frozen=True)
class Measure:
    """What a colour says of voxels or vertices of the surface: their numbers ``of`` (what is known of them,
    their points (n, 3) in metres, world, the unit vector up there) -> (n,), and the colours (256, 3) between
    two ends; or, without ``colors``, colours (n, 3) themselves. A voxel's point is its centre.

    ``ends`` are made from some of the numbers, and from the lowest and the highest height of the map.
    ``logarithmic``: equal ratios are equal steps. ``marks`` are the legend's words between two ends, at even
    distances, in place of the numbers. ``key`` are colours by what they mean, where colours are given.
    """

    label: str
    of: Callable[[Any, Floats, Floats], NDArray]
    colors: Callable[[float, float], NDArray[np.uint8]] | None = None
    ends: Callable[[Floats, Ends], Ends] = spread
    logarithmic: bool = False
    marks: Callable[[float, float], tuple[str, ...]] = lambda low, high: ()
    key: tuple[tuple[str, tuple[int, int, int]], ...] = ()

    def scale(self, some: NDArray, heights_m: Ends) -> "Scale":
        """The scale on which ``some`` of the numbers lie, in a map between two heights."""
        if self.colors is None:
            return Scale(self, 0.0, 1.0)
        numbers = some.astype(np.float64)
        if not self.logarithmic:
            return Scale(self, *self.ends(numbers, heights_m))
        low, high = self.ends(numbers[numbers > 0], heights_m)
        return Scale(self, max(low, high / _MOST_RATIO), high)


@dataclass(frozen=True)
class Scale:
    """A measure with the numbers at the ends of its colours."""

    measure: Measure
    low: float
    high: float

    @cached_property
    def colors(self) -> NDArray[np.uint8]:
        """The colours from the low to the high end, (256, 3); none if the measure gives colours."""
        made = self.measure.colors
        return np.zeros((0, 3), np.uint8) if made is None else made(self.low, self.high)

    def paint(self, known: Any, points_m: Floats, up: Floats) -> NDArray[np.uint8]:
        """Colours (n, 3) of voxels or vertices at points (n, 3)."""
        numbers = self.measure.of(known, points_m, up)
        if not len(self.colors):
            return numbers
        numbers, low, high = numbers.astype(np.float32), self.low, self.high
        if self.measure.logarithmic:
            numbers, low, high = np.log(np.maximum(numbers, low)), np.log(low), np.log(high)
        share = (numbers - low) / max(high - low, 1e-6)
        return self.colors[np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)]


@dataclass(frozen=True)
class Coloring:
    """One entry of the table: the ``help`` that the page shows; what the colours say of ``voxels``, and of
    vertices of the ``surface`` (None: each has the colour of the voxel behind it); and the data that voxels
    then need, of a ``layer`` if it is pixels that feed it."""

    help: str
    voxels: Measure
    surface: Measure | None = None
    needs: Need = ""
    layer: str = ""


def _chances(log_odds: NDArray[np.int16]) -> Floats:
    return 1.0 / (1.0 + np.exp(-log_odds * LOG_ODDS_STEP))


def _entropy(shown: Shown, points_m: Floats, up: Floats) -> Floats:
    p = np.clip(_chances(shown.log_odds), 1e-12, 1 - 1e-12)
    return -(p * np.log2(p) + (1 - p) * np.log2(1 - p))


def _chance_colors(low: float, high: float) -> NDArray[np.uint8]:
    """Colours of log-odds, blended between those of CHANCES."""
    at, colors = [at for at, _ in CHANCES.values()], np.array([color for _, color in CHANCES.values()])
    steps = np.linspace(low, high, 256)
    return np.stack([np.rint(np.interp(steps, at, each)) for each in colors.T], axis=1).astype(np.uint8)


def _chance_ends(log_odds: Floats, heights_m: Ends) -> Ends:
    """From even chances on, or from far below if less probable voxels are shown."""
    first, *_, last = (at for at, _ in CHANCES.values())
    return (first if log_odds.min(initial=0.0) < 0 else 0.0), last


def _chance_marks(low: float, high: float) -> tuple[str, ...]:
    names = list(CHANCES)
    return tuple(names[2:]) if low == 0 else (names[0], "1 in 2", names[-1])


def _of_pixels(layer: str, page: OnPage) -> Coloring:
    """The colouring of a layer that pixels feed. Vertices have colours alone of their own. Raises ConfigError
    for a name that a colouring without layer has."""
    if page.coloring in _FIRST or page.coloring in _LAST:
        raise ConfigError(f"layer {layer}: has page.coloring {page.coloring!r}, which is the page's own")

    def painted(known: Any, points_m: Floats, up: Floats) -> NDArray[np.uint8]:
        found = known.colors if layer == COLORS else known.layers.get(layer)
        return np.full(points_m.shape, NO_COLOR, np.uint8) if found is None else found

    measure = Measure(page.caption, painted, key=page.key)
    return Coloring(page.help, measure, measure if layer == COLORS else None, "colors", layer)


_HEIGHT_LABEL = "height above the lowest surface (m)"
_HEIGHT = Measure(
    _HEIGHT_LABEL,
    lambda known, points_m, up: points_m @ up,
    lambda low, high: ramp("Spectral_r"),
    ends=lambda numbers, heights_m: heights_m,
    marks=lambda low, high: ("0", _HEIGHT_LABEL, f"{high - low:.3g}"),
)
_PLAIN = Measure("", lambda known, points_m, up: np.full(points_m.shape, NO_COLOR, np.uint8))

_FIRST = {
    "height": Coloring("how high it is above its lowest surface.", _HEIGHT, _HEIGHT),
    "marginal probability": Coloring(
        "how sure the map is that a voxel is occupied: orange where it is unsure, blue where it is sure.",
        voxels=Measure(
            "chance that a voxel is occupied",
            lambda shown, points_m, up: shown.log_odds * LOG_ODDS_STEP,
            _chance_colors,
            _chance_ends,
            marks=_chance_marks,
        ),
    ),
    "uncertainty": Coloring(
        "how unsure it is: the entropy of a voxel, or the standard deviation of the surface.",
        voxels=Measure(
            "uncertainty: entropy (bits)", _entropy, lambda low, high: ramp("magma", 50), logarithmic=True
        ),
        surface=Measure(
            "uncertainty: standard deviation (cm)",
            lambda patch, points_m, up: 100.0 * patch.std_m,
            lambda low, high: ramp("magma", 50),
            logarithmic=True,
        ),
    ),
}
_LAST = {
    "keyframes that see it": Coloring(
        "how many keyframes have rays through the voxel.",
        voxels=Measure(
            "keyframes that see the voxel",
            lambda shown, points_m, up: shown.seen,
            lambda low, high: ramp("plasma"),
            lambda numbers, heights_m: (1.0, max(float(numbers.max(initial=0.0)), 2.0)),
            logarithmic=True,
        ),
        needs="counts",
    ),
    "plain grey": Coloring("nothing, so that what moves and what changed stands out.", _PLAIN, _PLAIN),
}
_BY_PIXELS = {made.page.coloring: _of_pixels(name, made.page) for name, made in pixel_layers().items()}

COLORINGS: dict[str, Coloring] = {**_FIRST, **_BY_PIXELS, **_LAST}
"""All colourings by name; the first is that of a new page."""


def shaded(colors: NDArray[np.uint8], facing: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (n, 3), darkened by the direction that the surface at each voxel is ``facing``."""
    return (colors * _SHADES[facing][:, None] + 128 >> 8).astype(np.uint8)


def pale(color: ArrayLike) -> NDArray[np.uint8]:
    """Colours of what is of an earlier map: RGB (..., 3), half way to white."""
    return (np.asarray(color, np.uint8) // 2 + 128).astype(np.uint8)


def legend_html(scale: Scale) -> str:
    """The scale as a strip with numbers, for the page."""
    label = scale.measure.label + ", log scale" * scale.measure.logarithmic
    if not len(scale.colors):
        said = f'<div style="padding:0 0.75em;font-size:0.85em">{label}</div>' if label else ""
        return said + _swatches(dict(scale.measure.key))
    ends = f"{scale.low:.3g}", label, f"{scale.high:.3g}"
    named = scale.measure.marks(scale.low, scale.high) or ends
    below = "" if label in named else f'<div style="text-align:center">{label}</div>'
    return (
        '<div style="padding:0 0.75em;font-size:0.85em">'
        f"{image_html(scale.colors[None], 'width:100%;height:0.9em;image-rendering:pixelated', label)}"
        '<div style="display:flex;justify-content:space-between">'
        f"{''.join(f'<span>{name}</span>' for name in named)}</div>{below}</div>"
    )


def key_html(space: bool, changes: Container[str]) -> str:
    """Key to the colours that are not on the scale, for the page: those of free space, and of changes of some
    kinds."""
    named: dict[str, tuple[int, ...]] = {**SPACE_COLORS, "unknown (not drawn)": (0, 0, 0, 0)} if space else {}
    marks = {"moves": DYNAMIC_COLOR, **CHANGE_COLORS}
    return _swatches(named | {kind: color for kind, color in marks.items() if kind in changes})


def _swatches(named: Mapping[str, tuple[int, ...]]) -> str:
    swatch = "display:inline-block;width:0.8em;height:0.8em;margin:0 0.4em 0 0.75em"
    spans = "".join(
        f'<div style="display:inline-block"><span style="{swatch};background:rgb{color}"></span>{name}</div>'
        for name, color in named.items()
    )
    return f'<div style="font-size:0.85em;padding-right:0.75em">{spans}</div>' if named else ""


def probabilities() -> NDArray[np.float64]:
    """The probability of each int16 of log-odds, viewed as uint16."""
    return _chances(np.arange(65536, dtype=np.uint16).view(np.int16)).astype(np.float64)
