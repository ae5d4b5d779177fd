"""Another mapping method, as a newcomer would add it: this folder, and its name in the list of plugs. It
has the parameters of log-odds."""

from taichi_mrf.config.method import Method

METHOD = Method(
    name="toy",
    summary="for a test",
    title="The toy",
    section="log_odds",
    map_class="toy_method.map:ToyMap",
    prior_is_unknown=True,
)
