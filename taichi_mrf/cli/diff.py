"""Command ``taichi-mrf diff``: load two maps, lay one over the other, compare them, write the changes, print
what appeared and left, and a table."""

import json
from pathlib import Path
from typing import Any

from rich.table import Table

from taichi_mrf.cli.options.saved_maps import Diff
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.export.ply import write_changes
from taichi_mrf.mapping.merging import lay_over
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import MapPart, in_chunks, take_part
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.change import STATES, MapChange, compare_maps
from taichi_mrf.queries.changed_things import ChangedThing, things_between
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_folder

MOST_THINGS = 20
"""Things that are printed, at most; the JSON has all."""


def run_diff(options: Diff) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    if options.out is not None and options.out.suffix.lower() != ".ply":
        raise ConfigError(f"{options.out}: --out must end in .ply")
    runtime.init(options.arch)
    a, b = _whole(options.a), _whole(options.b)
    located = None if isinstance(a, MapPart) or isinstance(b, MapPart) else lay_over(a, b)
    found = compare_maps(a, b)
    report = diff_report(found, str(options.a), str(options.b), a.voxel_size)
    report["located"] = None if located is None else located.to_json()
    report["things"] = [_thing(each) for each in things_between(found, a, b)]
    if options.out is not None:
        report["changes"] = {
            "file": str(options.out),
            "points": write_changes(options.out, found, a.voxel_size, a.config.volume.origin),
        }
    if options.json:
        print(json.dumps(report, indent=2))
    else:
        _print(report)
    return 0


def _thing(thing: ChangedThing) -> dict[str, Any]:
    place = {"centre_m": thing.centre_m.tolist(), "size_m": thing.size_m.tolist()}
    return {"verb": thing.verb, "voxels": thing.voxels, **place}


def _whole(path: Path) -> OccupancyMap | MapPart:
    """A saved map, with what is outside of its window."""
    if is_folder(path) and path.suffix == SUFFIX:
        return take_part(ChunkedMap.open(path))
    m = load_map(path)
    chunked = in_chunks(m)
    return m if chunked is None else take_part(chunked)


def diff_report(found: MapChange, a: str, b: str, voxel_size: float) -> dict[str, Any]:
    """The comparison as plain values; ``voxels`` by state in a, then by state in b."""
    return {
        "a": a,
        "b": b,
        "voxel_size": voxel_size,
        "known_in_both": found.in_both,
        "volume_in_both_m3": found.in_both * voxel_size**3,
        "only_in_a": found.only_in_a,
        "only_in_b": found.only_in_b,
        "changed_state": found.changed,
        "mean_difference": found.mean_difference,
        "mean_difference_known_in_either": found.mean_difference_known,
        "voxels": {
            before: {after: int(found.counts[i, j]) for j, after in enumerate(STATES)}
            for i, before in enumerate(STATES)
        },
    }


def _print(report: dict[str, Any]) -> None:
    console = Terminal()
    table = Table("voxels", *(f"{state} in B" for state in STATES), title_justify="left")
    for before, row in report["voxels"].items():
        # Voxels that are unknown in both maps cannot be counted.
        cells = ["" if before == after == STATES[0] else f"{count:,}" for after, count in row.items()]
        table.add_row(f"{before} in A", *cells)
    located = report["located"]
    lines: list[str | Table] = []
    if located is not None and located["T_map_recording"] is None:
        lines.append(f"B was not found in A, and is compared as it stands: {located['says']}")
    elif located is not None:
        lines.append(f"B located in A: {located['says']}")
    lines += [
        f"A is {report['a']}, B is {report['b']}; voxels of {report['voxel_size']:g} m",
        table,
        f"{report['known_in_both']:,} voxels ({report['volume_in_both_m3']:.1f} m3) known in both, "
        f"{report['only_in_a']:,} in A only, {report['only_in_b']:,} in B only",
        f"{report['changed_state']:,} of those known in both have changed between free and occupied",
        f"mean |difference| of probability {report['mean_difference']:.4f} over those known in both, "
        f"{report['mean_difference_known_in_either']:.4f} over those known in either",
    ]
    for thing in report["things"][:MOST_THINGS]:
        size = " x ".join(f"{side:.2f}" for side in thing["size_m"])
        centre = " ".join(f"{c:.2f}" for c in thing["centre_m"])
        lines.append(f"{thing['verb']}: {size} m at {centre}, {thing['voxels']:,} voxels")
    if len(report["things"]) > MOST_THINGS:
        lines.append(f"and {len(report['things']) - MOST_THINGS} smaller ones")
    if "changes" in report:
        lines.append(f"{report['changes']['file']} ({report['changes']['points']:,} points)")
    for line in lines:
        if isinstance(line, str):
            console.print_line(line)
        else:
            console.print(line)
