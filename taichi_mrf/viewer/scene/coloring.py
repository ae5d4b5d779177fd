"""View options, colours of voxels and their legend. No page is needed to import them.

The page's widgets are made from the options: a field's docstring is its help text, its range the slider's.
Heights have the colours that they have in a run's pictures. Probabilities are on a scale of log-odds that is
warm where the map is unsure and calm where it is sure, so that one watches it become sure. All other colour
scales are perceptually uniform.
"""

import base64
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.method import Range
from taichi_mrf.viewer.messages import LOG_ODDS_STEP, Hello
from taichi_mrf.viewer.scene.voxel_store import Shown
from taichi_mrf.voxels.colors import LOWEST, NO_COLOR

ColorBy = Literal["probability", "height", "uncertainty", "keyframes", "photo", "changes"]
Show = Literal["surface", "voxels", "points"]
LookName = Literal[
    "surface by height",
    "surface in photo colours",
    "surface by uncertainty",
    "voxels by height",
    "voxels in photo colours",
    "voxels by probability",
    "voxels by uncertainty",
    "voxels by keyframes",
    "free and unknown space",
    "measured points of the keyframe",
    "changes",
]
LOOKS: dict[LookName, tuple[Show, ColorBy]] = {
    "surface by height": ("surface", "height"),
    "surface in photo colours": ("surface", "photo"),
    "surface by uncertainty": ("surface", "uncertainty"),
    "voxels by height": ("voxels", "height"),
    "voxels in photo colours": ("voxels", "photo"),
    "voxels by probability": ("voxels", "probability"),
    "voxels by uncertainty": ("voxels", "uncertainty"),
    "voxels by keyframes": ("voxels", "keyframes"),
    "free and unknown space": ("voxels", "height"),
    "measured points of the keyframe": ("points", "photo"),
    "changes": ("voxels", "changes"),
}
"""Content of each look, and the meaning of its colour."""
SPACE: LookName = "free and unknown space"
OF_BELIEFS: tuple[LookName, ...] = (
    "voxels by height",
    "voxels by probability",
    "voxels by uncertainty",
    SPACE,
)
"""Looks that every map can have."""
CutAxis = Literal["none", "x", "y", "z"]


@dataclass(frozen=True)
class ViewOptions:
    """How the map is shown; nothing here changes the map."""

    look: LookName = "surface by height"
    """Show the surface that the keyframes measured, which is finer than voxels; the voxels of the map; the
    space that is known to be free, in a cut; the points that the chosen keyframe measured; or what moves, in
    red, with boxes around what appeared and left. The surface is made when no frames are read, at the end or
    while paused; until then voxels are shown in its place, coloured by how sure the map is of them."""

    threshold: Annotated[float, Range(0.02, 0.99, 0.01)] = 0.5
    """Show voxels whose probability of being occupied is at least this."""

    size: Annotated[float, Range(0.2, 2.0, 0.05)] = 1.0
    """Size of the points, in voxels."""

    shade: bool = True
    """Darken voxels and the surface a little by the direction that they face: shapes are easier to see."""

    cut_axis: CutAxis = "none"
    """Cut the map open across this axis of the world. The cut shows free space (blue), occupied (yellow) and
    unknown (nothing)."""

    cut_at_m: Annotated[float, Range(-1.0, 1.0, 0.01)] = 0.0
    """Coordinate of the cut on its axis in metres, of a level cut the height; the slider goes from one end of
    the map to the other."""

    flip_cut: bool = False
    """Hide what lies before the cut, and not what lies behind it: below a level cut, and not above it."""

    bricks: bool = False
    """Draw the outlines of the map's bricks of 8 x 8 x 8 voxels."""

    ground: bool = True
    """Draw squares on the ground, below the lowest large surface; a label says how wide they are."""

    axes: bool = True
    """Draw the axes of the world at its origin: x red, y green, z blue."""

    pictures: bool = True
    """Show each keyframe's depth image in its frustum."""

    follow: bool = False
    """Keep the view behind the camera."""

    show_baseline: bool = False
    """Also map the same keyframes with OctoMap's log-odds update, and show that map next to this one, or
    on the other side of the cut."""

    @property
    def shows(self) -> Show:
        """Content of the look."""
        return LOOKS[self.look][0]

    @property
    def color_by(self) -> ColorBy:
        """Meaning of the look's colour."""
        return LOOKS[self.look][1]


def looks_of(hello: Hello) -> tuple[LookName, ...]:
    """The looks that a map has the data for."""
    needs = (
        (hello.has_surface, "surface"),
        (hello.counts_keyframes, "keyframes"),
        (hello.has_dates, "changes"),
    )
    lacking, photo = {name for has, name in needs if not has}, hello.has_colors
    return tuple(
        look
        for look, (shows, by) in LOOKS.items()
        if not {shows, by} & lacking and (photo or by != "photo" or shows == "points")
    )


CHANCES: dict[str, tuple[float, tuple[int, int, int]]] = {
    "1 in 1000": (-6.907, (125, 130, 140)),
    "1 in 10": (-2.197, (196, 178, 160)),
    "1 in 2": (0.0, (240, 110, 40)),
    "9 in 10": (2.197, (247, 190, 95)),
    "99 in 100": (4.595, (150, 200, 180)),
    "999 in 1000": (6.907, (60, 140, 190)),
}
"""Chances that a voxel is occupied, as log-odds, and their colours; those between are blended."""

_MAPS: dict[ColorBy, str] = {
    "height": "Spectral_r",
    "uncertainty": "magma",
    "keyframes": "plasma",
    "photo": "bone",  # of no voxel
    "changes": "gray",
}

PHOTO_LABEL = "what cameras saw; grey where none did"

DYNAMIC_COLOR = (255, 30, 20)
"""The colour of dynamic voxels, which no scale has."""

CHANGE_COLORS = {"appeared": (40, 200, 90), "left": (255, 170, 30)}
"""Colours of the boxes around what appeared and what left."""

SPACE_COLORS = {"free": (70, 130, 200), "occupied": (253, 200, 36)}
"""Colours in a cut."""

_DARKENED = (0.75, 0.62, 1.0)
"""Brightness of surfaces perpendicular to x, y and z."""

_ACROSS = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1)
_SHADES = np.where(
    _ACROSS.any(axis=1), _ACROSS @ _DARKENED / np.maximum(_ACROSS.sum(axis=1), 1), sum(_DARKENED) / 3
)


@dataclass(frozen=True)
class Scale:
    """A colour scale: 256 colours (256, 3), the values at both ends, and their name.

    ``table`` gives the colour's index for each int16 of log-odds, viewed as uint16, or for each count of
    keyframes; heights have none. Colours and table follow from the other fields, so scales that agree in
    those are equal.
    """

    color_by: ColorBy
    colors: NDArray[np.uint8] = field(compare=False)
    low: float
    high: float
    label: str
    table: NDArray[np.uint8] | None = field(default=None, compare=False)
    marks: tuple[str, ...] = ()
    """Words at even distances from the low to the high end, in place of their numbers."""

    @cached_property
    def shaded(self) -> NDArray[np.uint8]:
        """The colours, darkened for each of 27 directions of a surface, (27 * 256, 3)."""
        return (self.colors * _SHADES[:, None, None] + 0.5).astype(np.uint8).reshape(-1, 3)


def scale_of(
    color_by: ColorBy, threshold: float, heights_m: tuple[float, float], most_keyframes: int = 1
) -> Scale:
    """The scale of a mode. ``heights_m`` are the lowest and the highest height, ``most_keyframes`` is the
    largest number of keyframes that see a voxel. Log-odds begin at even chances, or far below if less
    probable voxels are shown; counts of keyframes are on a logarithmic scale that ends at a power of two."""
    if color_by == "probability":
        return _chances(shows_unlikely=threshold < LOWEST)
    colors = _colors(color_by)
    if color_by in ("height", "changes"):
        return Scale(color_by, colors, *heights_m, "height (m)")
    if color_by == "keyframes":
        doublings = max(2, int(np.ceil(np.log2(max(most_keyframes, 1)))))
        share = np.log2(np.maximum(np.arange(256), 1)) / doublings
        label = "keyframes that see the voxel"
        return Scale(color_by, colors, 1.0, float(2**doublings), label, _numbers(share))
    if color_by == "photo":
        return Scale(color_by, colors, 0.0, 1.0, PHOTO_LABEL)
    return Scale(
        color_by, colors, 0.0, 1.0, "uncertainty: entropy (bits)", _numbers(_entropy(probabilities()))
    )


@cache
def _chances(shows_unlikely: bool) -> Scale:
    """The scale of log-odds, from even chances on or with those below."""
    named = list(CHANCES) if shows_unlikely else list(CHANCES)[2:]
    at = [CHANCES[name][0] for name in named]
    steps = np.linspace(at[0], at[-1], 256)
    channels = np.transpose([CHANCES[name][1] for name in named])
    colors = np.stack([np.rint(np.interp(steps, at, each)) for each in channels], axis=1).astype(np.uint8)
    log_odds = np.arange(65536, dtype=np.uint16).view(np.int16) * LOG_ODDS_STEP
    table = _numbers((log_odds - at[0]) / (at[-1] - at[0]))
    marks = (named[0], "1 in 2", named[-1]) if shows_unlikely else tuple(named)
    return Scale("probability", colors, at[0], at[-1], "chance that a voxel is occupied", table, marks)


@cache
def _colors(color_by: ColorBy) -> NDArray[np.uint8]:
    """The 256 colours (256, 3) of a mode, RGB."""
    from matplotlib import colormaps

    ends = (90, 190) if color_by == "changes" else (0, 255)  # grey that lets other colours stand out
    steps = np.linspace(*ends, 256).astype(int)
    found: NDArray[np.uint8] = colormaps[_MAPS[color_by]](steps, bytes=True)[:, :3]
    return np.ascontiguousarray(found)


def height_scale(range_m: float) -> Scale:
    """The scale of heights above the lowest surface, as a run's pictures have it."""
    return Scale("height", _colors("height"), 0.0, range_m, "height above the lowest surface (m)")


def std_scale(std_m: NDArray[np.floating]) -> Scale:
    """The scale of standard deviations of the surface, in centimetres, on which nearly all of these (n,), in
    metres, lie."""
    colors = scale_of("uncertainty", LOWEST, (0.0, 1.0)).colors
    most_mm = np.ceil(1000.0 * np.quantile(std_m, 0.95)) if len(std_m) else 1.0
    return Scale("uncertainty", colors, 0.0, float(max(most_mm, 1.0)) / 10.0, "standard deviation (cm)")


def std_colors(scale: Scale, std_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours (n, 3) of standard deviations (n,) in metres."""
    return scale.colors[_numbers(100.0 * std_m / scale.high)]


def voxel_colors(
    scale: Scale, shown: Shown, heights_m: NDArray[np.floating], facing: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Colours (n, 3) of a chunk's voxels with centres at these heights (n,), in metres; darkened by the
    direction of their surface if ``facing`` is given."""
    if scale.color_by == "photo":
        seen = np.full((len(heights_m), 3), NO_COLOR, np.uint8) if shown.colors is None else shown.colors
        return seen if facing is None else (seen * _SHADES[facing][:, None] + 0.5).astype(np.uint8)
    if scale.table is None:
        span = max(scale.high - scale.low, 1e-6)
        numbers = _numbers((heights_m - scale.low) / span)
    else:
        of = shown.seen if scale.color_by == "keyframes" else shown.log_odds.view(np.uint16)
        numbers = scale.table[of]
    if facing is None:
        return scale.colors[numbers]
    return scale.shaded[facing.astype(np.int32) * 256 + numbers]


def pale(color: ArrayLike) -> NDArray[np.uint8]:
    """Colours of what is of an earlier map: RGB (..., 3), half way to white."""
    return (np.asarray(color, np.uint8) // 2 + 128).astype(np.uint8)


def legend_html(scale: Scale) -> str:
    """The scale as a strip with numbers, for the page."""
    if scale.color_by == "photo":
        return f'<div style="padding:0 0.75em;font-size:0.85em">{scale.label}</div>'
    strip = np.ascontiguousarray(scale.colors[None, :, ::-1])
    named = scale.marks or (f"{scale.low:.3g}", scale.label, f"{scale.high:.3g}")
    below = f'<div style="text-align:center">{scale.label}</div>' if scale.marks else ""
    png = base64.b64encode(cv2.imencode(".png", strip)[1].tobytes()).decode("ascii")
    return (
        '<div style="padding:0 0.75em;font-size:0.85em">'
        f'<img alt="{scale.label}" style="width:100%;height:0.9em;image-rendering:pixelated" '
        f'src="data:image/png;base64,{png}">'
        '<div style="display:flex;justify-content:space-between">'
        f"{''.join(f'<span>{name}</span>' for name in named)}</div>{below}</div>"
    )


def key_html(options: ViewOptions) -> str:
    """Key to the colours that are not on the scale, for the page: those of a cut, and of changes."""
    in_cut = options.cut_axis != "none" and not options.show_baseline
    named = dict(SPACE_COLORS) if in_cut else {}
    if options.color_by == "changes":
        named |= {"moves: occupied now, usually free": DYNAMIC_COLOR, **CHANGE_COLORS}
    swatch = "display:inline-block;width:0.8em;height:0.8em;margin:0 0.4em 0 0.75em"
    together = "display:inline-block"
    spans = "".join(
        f'<div style="{together}"><span style="{swatch};background:rgb{color}"></span>{name}</div>'
        for name, color in named.items()
    )
    unknown = " · unknown: nothing" if in_cut else ""
    return f'<div style="font-size:0.85em">{spans}{unknown}</div>' if named else ""


def _numbers(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Positions between the low end (0) and the high end (1), as indices of colours."""
    return np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)


def probabilities() -> NDArray[np.float64]:
    """The probability of each int16 of log-odds, viewed as uint16."""
    return 0.5 * (1.0 + np.tanh(0.5 * np.arange(65536, dtype=np.uint16).view(np.int16) * LOG_ODDS_STEP))


def _entropy(p: NDArray[np.float64]) -> NDArray[np.float64]:
    p = np.clip(p, 1e-12, 1 - 1e-12)
    return -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
