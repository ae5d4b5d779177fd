"""Makes the pictures of docs/performance.md. They are measurements: run it on an idle machine.

    python docs/make_performance.py ../shared/data                          # all, half an hour
    python docs/make_performance.py ../shared/data performance_stages.png   # these

The figures go into runs/performance. The tables of the page are copied from there.
"""

import shutil
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
IMAGES, OUT = REPOSITORY / "docs" / "images", REPOSITORY / "runs" / "performance"
KITCHEN = "seven_scenes_redkitchen"
LAPS = "synthetic:room?frames=480&width=160&height=120"

BENCHES: dict[str, list[str]] = {
    "performance_stages.png": ["taichi_mrf", "bench", KITCHEN],
    "performance_kernels.png": ["benchmarks.speed", KITCHEN, "--measure", "profile"],
    "performance_growth.png": [
        "benchmarks.speed", LAPS, "--measure", "growth", "--frames", "480", "--voxel-sizes", "0.05",
    ],
}  # fmt: skip
"""The pictures of ``taichi-mrf bench --plot`` and of benchmarks/speed, each with its module and arguments."""

EVALUATIONS: dict[str, tuple[list[str], str]] = {
    "performance_rays.png": (["benchmarks.lab", "rays"], "rays_curve.png"),
    "performance_endless.png": (["benchmarks.lab", "endless", "--voxel-sizes", "0.1"], "endless_100mm.png"),
}
"""The pictures of benchmarks/lab: module and arguments, and the name that the command gives the picture."""


def main() -> None:
    """Make what the arguments name, or everything."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    known = [*BENCHES, *EVALUATIONS]
    data, wanted = Path(sys.argv[1]).resolve(), sys.argv[2:] or known
    strange = sorted(set(wanted) - set(known))
    if strange:
        sys.exit(f"no such picture: {', '.join(strange)}; there are {', '.join(known)}")
    OUT.mkdir(parents=True, exist_ok=True)
    for name in wanted:
        if name in EVALUATIONS:
            arguments, drawn = EVALUATIONS[name]
            program(*arguments, "--data", str(data), "--out", str(OUT))
            shutil.copyfile(OUT / drawn, IMAGES / name)
        else:
            arguments = [str(data / KITCHEN) if each == KITCHEN else each for each in BENCHES[name]]
            figures = OUT / Path(name).with_suffix(".json").name
            program(*arguments, "--plot", str(IMAGES / name), "--json", str(figures))


def program(*arguments: str) -> None:
    """Run a module with its output in this terminal."""
    subprocess.run([sys.executable, "-m", *arguments], check=True, cwd=REPOSITORY)


if __name__ == "__main__":
    main()
