"""The entry of the method visibility, with its parameters. No Taichi here: this is imported for a --help."""

from dataclasses import dataclass

from taichi_mrf.config.method import Method
from taichi_mrf.config.sliders import Range, Slider
from taichi_mrf.config.values import check_field


@dataclass(frozen=True)
class VisibilityConfig:
    """Visibility-aware occupancy mapping (Schauwecker & Zell, IROS 2014).

    The defaults are their Table I but for ``visible_if_occluded``: see TABLE_I.
    """

    hit_if_free: float = 0.43
    """P(H | V, not O): probability of a hit for a visible voxel that is free."""

    hit_if_occupied: float = 0.55
    """P(H | V, O): probability of a hit for a visible voxel that is occupied."""

    hit_if_hidden: float = 0.05
    """P(H | not V): probability of a hit for a voxel that is not visible."""

    visible_if_occluded: float = 0.45
    """P(V_i | C_i, V_i-1): probability that a locally occluded voxel behind a visible one is visible. From
    0.4 on (with q_max at 0.7) rays pass unknown voxels at once; with less, as with the paper's 0.2, the map
    grows by a few voxels a frame."""

    visible_if_clear: float = 1.0
    """P(V_i | not C_i, V_i-1): the same for a voxel that is not locally occluded."""

    q_min: float = 0.1
    """A ray ends where the probability of visibility falls below this."""

    q_max: float = 0.7
    """A probability of visibility of at least this counts as 1."""

    lowest: float = 0.1192
    """Lower bound on a voxel's probability (OctoMap's default)."""

    highest: float = 0.971
    """Upper bound on a voxel's probability (OctoMap's default)."""

    max_range: float = 0.0
    """Cut rays off at this range (metres). The end of a cut ray counts as free. 0 means no limit."""

    def __post_init__(self) -> None:
        for name in ("hit_if_free", "hit_if_occupied", "hit_if_hidden"):
            check_field(0 < getattr(self, name) < 1, f"visibility.{name}", "must lie between 0 and 1")
        for name in ("visible_if_occluded", "visible_if_clear", "q_min", "q_max"):
            check_field(0 <= getattr(self, name) <= 1, f"visibility.{name}", "must lie from 0 to 1")
        check_field(self.q_min < self.q_max, "visibility.q_max", "must be more than visibility.q_min")
        check_field(0 < self.lowest < 0.5, "visibility.lowest", "must lie between 0 and 0.5")
        check_field(0.5 < self.highest < 1, "visibility.highest", "must lie between 0.5 and 1")
        check_field(self.max_range >= 0, "visibility.max_range", "must not be negative")


TABLE_I = VisibilityConfig(visible_if_occluded=0.2)
"""The parameters of the paper's Table I. They need a camera that moves less than a voxel a frame."""

METHOD = Method(
    name="visibility",
    summary="visibility-aware, by Schauwecker and Zell",
    title="Visibility (Schauwecker & Zell)",
    section="visibility",
    section_class=VisibilityConfig,
    section_help="Visibility-aware occupancy mapping (method visibility).",
    map_class="taichi_mrf.methods.visibility.map:VisibilityMap",
    sliders=(
        Slider("hit_if_free", Range(0.02, 0.98, 0.01)),
        Slider("hit_if_occupied", Range(0.02, 0.98, 0.01)),
        Slider("hit_if_hidden", Range(0.01, 0.98, 0.01)),
        Slider("visible_if_occluded", Range(0.0, 1.0, 0.01)),
    ),
    prior_is_unknown=True,
    if_empty="raise visibility.visible_if_occluded (from 0.4 on rays pass unknown voxels) or map more frames",
)
