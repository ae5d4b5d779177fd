"""Makes pictures and tables of every peer in docs/evaluation.md from `taichi-mrf eval peers` (extra `bench`).

    python docs/make_peers.py ../shared/data

The results are kept in runs/peers, so that a run that was stopped continues; all of it takes an hour or two.
The figures of the rows that docs/results/peers.csv and peers_space.csv have go there, and from there into the
pages (result_tables.py).
"""

import csv
import shutil
import subprocess
import sys
from pathlib import Path

import result_tables

REPOSITORY = Path(__file__).resolve().parent.parent
IMAGES, OUT = REPOSITORY / "docs" / "images", REPOSITORY / "runs" / "peers"

PICTURES: dict[str, list[str]] = {
    "peers_kitchen.png": ["--only", "kitchen*"],
    "peers_room.png": ["--only", "room, 5 cm*", "room, 2 cm, [MOhlvT]*", "room, 1 cm, [MlT]*"],
    "peers_house.png": ["--only", "house, 5 cm*", "house, 2 cm, [MhlT]*", "house, 1 cm, [MT]*"],
    "peers_lidar.png": ["--only", "lidar, 20 cm*", "lidar, 5 cm, [MOhl]*", "--voxel-sizes", "0.2", "0.05"],
}
"""The pictures, each with its arguments: the systems by their first letters where not all were measured."""


def main() -> None:
    """Run each part, copy its picture, and take its figures."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    figures: dict[str, result_tables.Rows] = {"peers.csv": {}, "peers_space.csv": {}}
    for name, arguments in PICTURES.items():
        run = ["eval", "peers", "--data", sys.argv[1], "--out", str(OUT), *arguments]
        subprocess.run([sys.executable, "-m", "taichi_mrf", *run], check=True)
        shutil.copyfile(OUT / name, IMAGES / name)
        figures["peers.csv"] |= budgets(OUT / "peers_budgets.csv")
        figures["peers_space.csv"] |= spaces(OUT / "peers_states.csv")
    for file, found in figures.items():
        path = result_tables.RESULTS / file
        columns, rows = result_tables.read(path)
        result_tables.write(path, columns, {key: found[key] for key in rows})
    result_tables.main()


def budgets(path: Path) -> result_tables.Rows:
    """The rows that the command wrote, as the page has them: the share of right pixels within 20, 150 and 500
    ms, and the log-likelihood within 500 ms."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found: result_tables.Rows = {}
    for row in rows:
        cells = [row[f"{budget} ms"] for budget in (20, 150, 500)]
        right = [figure(cell.split(" / ")[0], 3) if "/" in cell else "-" for cell in cells]
        likely = figure(cells[-1].split(" / ")[1], 2) if "/" in cells[-1] else "-"
        found[row["scene"], row["voxels"], row["system"]] = [*right, likely]
    return found


def spaces(path: Path) -> result_tables.Rows:
    """The rows that the command wrote on known space: MRFMap's by its calibrated probabilities, and by its
    mesh, which stands with the marginals."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found: result_tables.Rows = {}
    for row in rows:
        name, _, reading = row["map"].partition(", ")
        cells = [row["occupied precision"], row["occupied recall"], row["calibration error"], row["F 2 cm"]]
        new = [figure(cell, 3) if cell else "-" for cell in cells]
        mesh = found.get((row["scene"], row["voxels"], name), new)[-1] if reading == "calibrated" else new[-1]
        found[row["scene"], row["voxels"], name] = [*new[:-1], mesh]
    return found


def figure(number: str, digits: int) -> str:
    """A number as pages write it: no zero before the point."""
    text = f"{float(number):.{digits}f}"
    return text.replace("0.", ".", 1) if abs(float(text)) < 1 else text


if __name__ == "__main__":
    main()
