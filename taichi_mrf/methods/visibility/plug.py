"""The entry of the method visibility. No Taichi here: this is imported for a --help."""

from taichi_mrf.config.method import Method
from taichi_mrf.config.sections import VisibilityConfig

TABLE_I = VisibilityConfig(visible_if_occluded=0.2)
"""The parameters of the paper's Table I. They need a camera that moves less than a voxel a frame."""

METHOD = Method(
    name="visibility",
    summary="visibility-aware, by Schauwecker and Zell",
    title="Visibility (Schauwecker & Zell)",
    section="visibility",
    map_class="taichi_mrf.methods.visibility.map:VisibilityMap",
    prior_is_unknown=True,
    if_empty="map more frames: the known space grows from frame to frame",
)
