"""Makes docs/images/room.png, the picture on the front page: the surface.png that ``make run`` leaves.

    python docs/make_room_picture.py [FILE]

Maps the built-in room on the CPU, of which every run leaves the same bytes, and copies the picture.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
PICTURE = REPOSITORY / "docs" / "images" / "room.png"


def main() -> None:
    """Map, copy."""
    picture = Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE
    with tempfile.TemporaryDirectory() as folder:
        words = ["map", "synthetic:room", "--out", folder, "--runtime.arch", "cpu", "--quiet"]
        subprocess.run([sys.executable, "-m", "taichi_mrf", *words], check=True)
        shutil.copyfile(Path(folder, "surface.png"), picture)


if __name__ == "__main__":
    main()
