"""The built-in room in colour as one HTML file, which a visitor of the site turns before installing anything.

    python docs/map_page.py FILE

site.py adds it to the site as map.html.
"""

import sys
import tempfile
from functools import cache
from pathlib import Path

import taichi_mrf as tm


@cache
def map_page() -> str:
    """Map the room and export it. ``mkdocs serve`` does so once."""
    tm.init("cpu")
    m = tm.MRFMap(voxel_size=0.05, noise=tm.PolynomialNoise(sigma=(0.001504, -0.00152, 0.0019)))
    for frame in tm.open_dataset("synthetic:room?frames=29&width=320&height=240", color=True):
        m.add(frame)
    m.infer()
    with tempfile.TemporaryDirectory() as folder:
        (page,) = tm.export_map(m, Path(folder, "map.html"))
        return page.read_text(encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    Path(sys.argv[1]).write_text(map_page(), encoding="utf-8")
