"""The description of a mapping method and its sliders for the rest of the program, made in the method's own
folder.

Kept apart from the list of entries (registry.py), because each method's folder imports this.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Range:
    """The smallest and largest value of a slider, and its step."""

    least: float
    most: float
    step: float


def always(section: Any) -> bool:
    """The condition of a parameter that always has an effect."""
    return True


@dataclass(frozen=True)
class Slider:
    """One parameter of a section that the tuning page offers.

    ``name`` is the field's name. ``range`` is None for a choice or a switch. With ``decades`` the slider
    and its range are powers of ten. ``counts`` takes the section and says whether the parameter
    changes anything under the section's other values. The automatic search varies a parameter by steps, or by
    factors if ``by_factors``, and those that are ``searched`` unless others are named.
    """

    name: str
    range: Range | None = None
    unit: str = ""
    decades: bool = False
    counts: Callable[[Any], bool] = always
    by_factors: bool = False
    searched: bool = False


@dataclass(frozen=True)
class Method:
    """A mapping method: its names, its section of the configuration, its class and what its maps can do."""

    name: str
    """Name of the method in ``Config.method``, ``--method`` and map files."""

    summary: str
    """The method in a few words, for the help of ``--method``."""

    title: str
    """The heading of its sliders on the tuning page."""

    section: str
    """The field of ``Config`` that holds its parameters, its own or those of a method that it resembles."""

    map_class: str
    """Class of its maps, ``package.module:Class``. It is imported when the first map is made, because it
    brings Taichi and its kernels."""

    sliders: tuple[Slider, ...] = ()
    """The parameters of its section that the tuning page offers, in the order of the page."""

    has_messages: bool = False
    """Keyframes keep messages (methods/capabilities.py): a change is renewed without starting over, and
    inference that was stopped can be undone. A map that was loaded has to infer before it can be edited."""

    can_freeze: bool = False
    """Keyframes can be folded into the map for good."""

    can_refine_poses: bool = False
    """Keyframes can be aligned with the map: pose refinement and tracking."""

    has_layers: bool = False
    """Its map of a changing world can be read as of another time and by layers."""

    has_colors: bool = False
    """Keyframes may have colour images, and voxels then have colours."""

    measures_surface: bool = False
    """Its maps can make a surface from the keyframes' measurements."""

    prior_is_unknown: bool = False
    """A voxel is unknown exactly if it still holds the prior. Otherwise ``volume.min_evidence`` decides."""

    is_octomap: bool = False
    """Its voxels hold what OctoMap's leaves hold: an imported OctoMap file is a map of this method, and the
    live page shows its map of the same keyframes as the baseline. One method has this."""

    if_empty: str = ""
    """Advice for a map of this method without occupied voxels, as the end of a sentence."""

    @property
    def class_name(self) -> str:
        """The name of the map's class, without its module."""
        return self.map_class.partition(":")[2]

    def load_class(self) -> Any:
        """The class of the method's maps, imported now."""
        module, _, name = self.map_class.partition(":")
        return getattr(importlib.import_module(module), name)
