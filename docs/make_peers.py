"""Makes the pictures of every peer in docs/evaluation.md from `taichi-mrf eval peers` (extra `bench`).

    python docs/make_peers.py ../shared/data

The results are kept in runs/peers, so that a run that was stopped continues; all of it takes hours.
"""

import shutil
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
IMAGES, OUT = REPOSITORY / "docs" / "images", REPOSITORY / "runs" / "peers"

PICTURES: dict[str, list[str]] = {
    "peers_kitchen.png": ["--only", "kitchen*"],
    "peers_room.png": ["--only", "room, 5 cm*", "room, 2 cm, [MOhlvT]*", "room, 1 cm, [MlT]*"],
    "peers_house.png": ["--only", "house, 5 cm*", "house, 2 cm, [MhlT]*", "house, 1 cm, [MT]*"],
    "peers_lidar.png": ["--only", "lidar, 20 cm*", "lidar, 5 cm, [Mhl]*", "--voxel-sizes", "0.2", "0.05"],
}
"""The pictures, each with its arguments: the systems by their first letters where not all were measured."""


def main() -> None:
    """Run each part and copy its picture."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    for name, arguments in PICTURES.items():
        run = ["eval", "peers", "--data", sys.argv[1], "--out", str(OUT), *arguments]
        subprocess.run([sys.executable, "-m", "taichi_mrf", *run], check=True)
        shutil.copyfile(OUT / name, IMAGES / name)


if __name__ == "__main__":
    main()
