"""Command ``taichi-mrf merge``: locate saved maps in each other, and write one map of all their keyframes."""

import json
from typing import Any

from taichi_mrf.cli.options.saved_maps import Merge
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import ConfigError
from taichi_mrf.mapping.merging import Merged, merge
from taichi_mrf.methods.registry import load_map
from taichi_mrf.system import runtime


def run_merge(options: Merge) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.out.suffix.lower() != ".npz":
        raise ConfigError(f"{options.out}: --out must end in .npz")
    if len(options.maps) < 2:
        raise ConfigError("merge needs two maps or more: taichi-mrf merge A.npz B.npz --out C.npz")
    runtime.init(options.arch)
    merged = merge([load_map(path) for path in options.maps], [str(path) for path in options.maps])
    merged.map.save(options.out)
    if options.json:
        print(json.dumps(_facts(options, merged), indent=2))
        return 0
    console = Terminal()
    for path, located in zip(options.maps[1:], merged.located, strict=True):
        console.print_line(f"{path} located: {located.in_words()}")
    if merged.map.keyframes:
        console.print_line(
            f"{len(merged.map.keyframes)} keyframes, {merged.loops} of them aligned with those of another "
            f"map, which moved keyframes by up to {100 * merged.moved_m:.1f} cm"
        )
    console.print_line(str(options.out))
    return 0


def _facts(options: Merge, merged: Merged) -> dict[str, Any]:
    """Locations of the maps, as plain values."""
    places = zip(options.maps[1:], merged.located, strict=True)
    return {
        "map": str(options.out),
        "keyframes": len(merged.map.keyframes),
        "located": {str(path): located.to_json() for path, located in places},
        "loops": merged.loops,
        "moved_m": merged.moved_m,
    }
