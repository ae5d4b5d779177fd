"""``taichi-mrf map``: one sequence here, several or a cluster, or one in submaps."""

from taichi_mrf.cli.map.many import run_many
from taichi_mrf.cli.map.run import run_map
from taichi_mrf.cli.options.map import Map


def run(options: Map) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.submap_size is not None:
        from taichi_mrf.cli.map.submaps import run_submaps

        return run_submaps(options, options.submap_size)
    return run_map(options) if len(options.sources) == 1 and options.scheduler is None else run_many(options)
