"""The picture on the front page is what its script makes of `taichi-mrf map synthetic:room`."""

import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest
from PIL import Image


@pytest.mark.slow
def test_the_script_makes_the_same_bytes(repository: Path, tmp_path: Path) -> None:
    kept = repository / "docs" / "images" / "room.png"
    with Image.open(kept) as picture:
        drawn_by = picture.info["Software"]
    if f"version{mpl.__version__}," not in drawn_by:
        pytest.skip(f"Matplotlib {mpl.__version__} draws other letters ({drawn_by} drew the picture)")
    made = tmp_path / "room.png"
    script = repository / "docs" / "make_room_picture.py"
    subprocess.run([sys.executable, str(script), str(made)], cwd=repository, check=True)
    assert made.read_bytes() == kept.read_bytes()
