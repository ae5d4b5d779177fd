"""Makes docs/results/thin.csv and thin_maps.csv, the tables of docs/free.md, by benchmarks/thin.py.

python -m benchmarks.thin --room all --sensor camera --voxel-size 0.05 0.02 --json camera.json
python -m benchmarks.thin --room all --sensor lidar --voxel-size 0.05 0.02 --json lidar.json
python docs/make_thin_tables.py camera.json lidar.json
"""

import json
import sys
from pathlib import Path
from typing import Any

from result_tables import RESULTS, Rows, write

METHODS = {"mrf": "MRFMap", "log_odds": "log-odds", "wavemap": "wavemap's model"}
KINDS = ["room", "voxels", "thing", *(f"{name}: occupied (free)" for name in METHODS.values())]
PATHS = ["hit through", "hit past"]
MAPS = ["room", "voxels", "map", "precision", "too early"]
WALL = "wall"
SHOWN = {
    ("room, camera", "5 cm"), ("room, camera", "2 cm"), ("fence, camera", "5 cm"),
    ("clutter, camera", "5 cm"), ("room, lidar", "5 cm"), ("fence, lidar", "5 cm"), ("yard, lidar", "5 cm"),
}  # fmt: skip


def main() -> None:
    """Write both files."""
    results = [each for path in sys.argv[1:] for each in json.loads(Path(path).read_text(encoding="utf-8"))]
    things: Rows = {}
    maps: Rows = {}
    for result in results:
        where = (f"{result['room']}, {result['sensor']}", f"{100 * result['voxel_size']:g} cm")
        if where not in SHOWN:
            continue
        maps[(*where, METHODS[result["method"]])] = [f"{result['precision']:.3f}", f"{result['blocked']:.3f}"]
        for kind, found in result["kinds"].items():
            if kind != WALL and found["voxels"]:
                row = things.setdefault((*where, kind), ["-"] * (len(METHODS) + len(PATHS)))
                row[list(METHODS).index(result["method"])] = said(found)
                if result["method"] == "mrf":
                    row[len(METHODS) :] = [mean(found["hit_mean"]), mean(found["past_mean"])]
    write(RESULTS / "thin.csv", [*KINDS, *PATHS], things)
    write(RESULTS / "thin_maps.csv", MAPS, maps)


def said(found: dict[str, Any]) -> str:
    """What a map says of the voxels of a kind of thing."""
    return f"{mean(found['occupied'])} ({mean(found['free'])})"


def mean(share: float | None) -> str:
    """A share with two digits, a dash without one."""
    return "-" if share is None or share != share else f"{share:.2f}"


if __name__ == "__main__":
    main()
