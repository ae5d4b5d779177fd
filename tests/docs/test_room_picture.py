"""The picture on the front page is what its script makes of `taichi-mrf map synthetic:room`: the same bytes
on a processor like the one that drew it. Others round otherwise, which moves edges by a pixel."""

import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

OTHERWISE = 0.01
"""Share of the pixels that may look otherwise: .4% do after rounding on a Xeon and on an EPYC."""

LEVELS = 8
"""Of 255, by which a pixel looks otherwise."""


@pytest.mark.slow
def test_the_script_makes_the_same_picture(repository: Path, tmp_path: Path) -> None:
    kept = repository / "docs" / "images" / "room.png"
    with Image.open(kept) as picture:
        drawn_by = picture.info["Software"]
    if f"version{mpl.__version__}," not in drawn_by:
        pytest.skip(f"Matplotlib {mpl.__version__} draws other letters ({drawn_by} drew the picture)")
    made = tmp_path / "room.png"
    script = repository / "docs" / "make_room_picture.py"
    subprocess.run([sys.executable, str(script), str(made)], cwd=repository, check=True)
    with Image.open(kept) as before, Image.open(made) as now:
        assert now.size == before.size
        differences = np.asarray(now, np.int16) - np.asarray(before, np.int16)
    assert (np.abs(differences).max(axis=-1) > LEVELS).mean() < OTHERWISE
