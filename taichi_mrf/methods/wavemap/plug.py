"""The entry of the method wavemap. No Taichi here: this is imported for a --help."""

from taichi_mrf.config.method import Method

REACH_SIGMAS = 6.0
"""Nothing is concluded further off a beam's axis, or further behind its measurement, in sigmas."""

METHOD = Method(
    name="wavemap",
    summary="wavemap's measurement model, by Reijgwart and others",
    title="wavemap's model",
    section="wavemap",
    map_class="taichi_mrf.methods.wavemap.map:WavemapMap",
    prior_is_unknown=True,
    if_empty="try larger voxels: where they are smaller than the beams are apart, the model says little",
)
