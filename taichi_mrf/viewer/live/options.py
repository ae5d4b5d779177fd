"""What a viewer of the map can choose. The page's widgets are made from this class: a field's docstring is
its help text, its range the slider's."""

from dataclasses import dataclass
from typing import Annotated, Literal

from taichi_mrf.viewer.widgets import Range

ColorBy = Literal["marginal", "height", "uncertainty", "keyframes"]
CutAxis = Literal["none", "x", "y", "z"]


@dataclass(frozen=True)
class ViewOptions:
    """How the map is shown; nothing here changes the map."""

    color_by: ColorBy = "marginal"
    """What the colour says: the marginal probability, the height, the uncertainty (entropy), or how many
    keyframes' rays went through the voxel."""

    threshold: Annotated[float, Range(0.02, 0.99, 0.01)] = 0.5
    """Voxels of at least this probability of being occupied are shown."""

    size: Annotated[float, Range(0.2, 2.0, 0.05)] = 1.0
    """Size of the points, in voxels."""

    shade: bool = True
    """Darken voxels a little by the way their surface faces, so that shapes are easier to see."""

    cut_axis: CutAxis = "none"
    """Cut the map open across this axis; the cut shows what is free (blue), occupied (yellow) and unknown
    (nothing)."""

    cut_at: Annotated[float, Range(0.0, 1.0, 0.005)] = 0.5
    """Where the cut is, from one end of the map (0) to the other (1)."""

    bricks: bool = False
    """Draw the outlines of the 8 x 8 x 8 bricks that the map holds."""

    pictures: bool = True
    """Show each keyframe's depth image in its frustum."""

    follow: bool = False
    """Keep the view behind the camera that is mapping."""

    beside: bool = False
    """Map the same keyframes OctoMap's way too, and show that map next to this one."""

    dark: bool = False
    """Dark colours for the page."""
