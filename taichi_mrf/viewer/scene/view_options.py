"""How the map is shown: the layers of the scene, each on or off, and what belongs to them.

The page's widgets are made from the options: a field's docstring is its help text, its range the slider's.
"""

from collections.abc import Container
from dataclasses import dataclass
from typing import Annotated, Literal

from taichi_mrf.config.method import Range
from taichi_mrf.viewer.messages import Hello
from taichi_mrf.viewer.scene.coloring import COLORINGS

Draw = Literal["surface", "voxels"]
CutAxis = Literal["none", "x", "y", "z"]


@dataclass(frozen=True)
class ViewOptions:
    """How the map is shown; nothing here changes the map."""

    map: bool = True
    """Show the map."""

    draw_as: Draw = "surface"
    """Draw the map as the surface that the keyframes measured, which is finer than voxels, or as voxels. The
    surface is made when no frames are read, at the end or while paused; until then voxels are shown in its
    place."""

    color_by: str = next(iter(COLORINGS))
    """What the colours of the map say."""

    threshold: Annotated[float, Range(0.02, 0.99, 0.01)] = 0.5
    """Show voxels whose probability of being occupied is at least this."""

    size: Annotated[float, Range(0.2, 2.0, 0.05)] = 1.0
    """Size of the points, in voxels."""

    shade: bool = True
    """Darken voxels and the surface a little by the direction that they face: shapes are easier to see."""

    keyframes: bool = True
    """Show the keyframes: a small frustum each, or rings for a lidar."""

    pictures: bool = True
    """Show each keyframe's depth image in its frustum."""

    path: bool = True
    """Show the path of the camera, and where it is now."""

    points: bool = False
    """Show the points that the chosen keyframe measured, in the colours of its photo or else of depth."""

    changes: bool = True
    """Show what moves in red, and boxes around what appeared (green) and left (orange)."""

    baseline: bool = False
    """Also map the same keyframes with OctoMap's log-odds update, and show that map next to this one, or
    on the other side of the cut."""

    free_space: bool = False
    """Show in a cut what is known to be free (blue), occupied (yellow) and unknown (nothing). Without a cut,
    make a level one."""

    cut_axis: CutAxis = "none"
    """Cut the map open across this axis of the world."""

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

    follow: bool = False
    """Keep the view behind the camera."""


OF_LAYER = {
    **dict.fromkeys(("draw_as", "color_by", "threshold", "size", "shade"), "map"),
    "pictures": "keyframes",
    **dict.fromkeys(("cut_at_m", "flip_cut"), "cut_axis"),
}
"""Options that belong to another one, and stand indented below it."""


def colorings_of(hello: Hello, layers: Container[str] = ()) -> tuple[str, ...]:
    """The colourings that a map has the data for, of which pixels have fed these ``layers``."""
    fit = {name: c for name, c in COLORINGS.items() if not c.layer or c.layer in layers}
    return tuple(name for name, c in fit.items() if c.needs != "counts" or hello.counts_keyframes)


def drawings_of(hello: Hello) -> tuple[Draw, ...]:
    """What a map can be drawn as."""
    return ("surface", "voxels") if hello.has_surface else ("voxels",)
