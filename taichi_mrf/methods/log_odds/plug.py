"""The entry of the method log_odds. No Taichi here: this is imported for a --help."""

from taichi_mrf.config.method import Method, Range, Slider

METHOD = Method(
    name="log_odds",
    summary="independent log-odds as in OctoMap",
    title="Log-odds (OctoMap)",
    section="log_odds",
    map_class="taichi_mrf.methods.log_odds.map:LogOddsMap",
    sliders=(
        Slider("hit", Range(0.51, 0.98, 0.01)),
        Slider("miss", Range(0.02, 0.49, 0.01)),
        Slider("lowest", Range(0.01, 0.49, 0.01)),
        Slider("highest", Range(0.51, 0.99, 0.01)),
    ),
    prior_is_unknown=True,
    is_octomap=True,
)
