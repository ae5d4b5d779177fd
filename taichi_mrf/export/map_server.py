"""2D maps in the format of ROS's map_server: a grey image and a YAML file with its position."""

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from taichi_mrf.system.atomic import atomic_path, write_text

OCCUPIED_GREY, FREE_GREY, UNKNOWN_GREY = 0, 254, 205
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""map_server's thresholds: a cell is occupied from the first probability on, free up to the second; the three
grey values stand for 1, 0.004 and 0.196, the last of which it reads as unknown."""


def grey_image(occupied: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Cells (rows, columns), rows from the lowest y up, as an image whose top row has the highest y."""
    grey = np.where(occupied, OCCUPIED_GREY, FREE_GREY)
    return np.flipud(np.where(seen, grey, UNKNOWN_GREY)).astype(np.uint8)


def write_map_server(
    folder: Path,
    image: NDArray[np.uint8],
    cell_size: float,
    lower_corner_m: tuple[float, float],
    name: str = "map",
    note: str | None = None,
) -> list[Path]:
    """Write ``map.pgm`` and ``map.yaml``, or of another name; returns their paths. Raises MapFileError.

    ``lower_corner_m`` is the outer corner of the image's lower left pixel, in metres, as is ``cell_size``.
    ``note`` becomes a comment in the YAML file.
    """
    pgm, description = folder / f"{name}.pgm", folder / f"{name}.yaml"
    height, width = image.shape
    with atomic_path(pgm) as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode("ascii") + image.tobytes())
    values = {
        "image": pgm.name,
        "resolution": float(cell_size),
        "origin": [float(lower_corner_m[0]), float(lower_corner_m[1]), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    comment = "" if note is None else f"# {note}\n"
    write_text(description, comment + yaml.safe_dump(values, sort_keys=False, default_flow_style=None))
    return [pgm, description]
