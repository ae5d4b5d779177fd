"""View options. The page's widgets are made from this class: a field's docstring is its help text, its range
the slider's. No page is needed to import it."""

from dataclasses import dataclass
from typing import Annotated, Literal

from taichi_mrf.config.method import Range

ColorBy = Literal["marginal", "height", "uncertainty", "keyframes", "photo"]
OF_BELIEFS: tuple[ColorBy, ...] = ("marginal", "height", "uncertainty")
"""Choices of what the colour shows of every map."""
Show = Literal["surface", "voxels"]
CutAxis = Literal["none", "x", "y", "z"]


@dataclass(frozen=True)
class ViewOptions:
    """How the map is shown; nothing here changes the map."""

    show: Show = "surface"
    """Show the surface that the keyframes measured, below the size of voxels, or the voxels of the map. The
    surface is made when no frames are read, at the end or while paused; until then voxels are shown."""

    color_by: ColorBy = "height"
    """Meaning of the colour: the probability, the height, the uncertainty (of a voxel its entropy, of the
    surface its standard deviation), the number of keyframes whose rays pass through the voxel, or what
    cameras saw (photo)."""

    threshold: Annotated[float, Range(0.02, 0.99, 0.01)] = 0.5
    """Show voxels whose probability of being occupied is at least this."""

    size: Annotated[float, Range(0.2, 2.0, 0.05)] = 1.0
    """Size of the points, in voxels."""

    shade: bool = True
    """Darken voxels and the surface a little by the direction that they face: shapes are easier to see."""

    cut_axis: CutAxis = "none"
    """Cut the map open across this axis. The cut shows free space (blue), occupied (yellow) and unknown
    (nothing)."""

    cut_at: Annotated[float, Range(0.0, 1.0, 0.005)] = 0.5
    """Position of the cut, from one end of the map (0) to the other (1)."""

    bricks: bool = False
    """Draw the outlines of the map's bricks of 8 x 8 x 8 voxels."""

    pictures: bool = True
    """Show each keyframe's depth image in its frustum."""

    follow: bool = False
    """Keep the view behind the camera."""

    show_baseline: bool = False
    """Also map the same keyframes with OctoMap's log-odds update, and show that map next to this one."""

    dynamic: bool = True
    """Show in red what is dynamic: occupied now, although all keyframes together say that it is free."""

    dark: bool = False
    """Dark colours for the page's panel."""
