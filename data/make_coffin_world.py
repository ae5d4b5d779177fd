"""Makes the scene of MRFMap's Table I for `taichi-mrf eval` from the authors' public files.

    git clone https://github.com/mrfmap/mrfmap
    git clone https://github.com/mrfmap/mrfmap_ros
    python data/make_coffin_world.py mrfmap mrfmap_ros scenes/coffin_world
    taichi-mrf eval table1 --data scenes

The first repository has 12 depth images (``data/depth_*.bin``) with the poses of the robot's body and, in
``config/coffin_world_640.yaml``, the camera; the second has what the authors learnt of the sensor's noise
(``config/polys``). Both are under the BSD licence of three clauses.
"""

import sys
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

VIEWS = 12
TERMS = 3
"""Coefficients of a patch, ascending powers of the depth in metres."""

NOISE = ("realsense_bias_poly5x", "realsense_stddev_poly5x")


def main() -> None:
    """Convert; a file that is missing or of another shape ends the program with one line."""
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    library, wrapper, out = map(Path, sys.argv[1:])
    try:
        convert(library, wrapper, out)
    except (OSError, ValueError, KeyError, TypeError) as error:
        sys.exit(f"not converted: {error}")


def convert(library: Path, wrapper: Path, out: Path) -> None:
    """Write the views and the noise's tables into a folder."""
    settings = yaml.safe_load((library / "config" / "coffin_world_640.yaml").read_text(encoding="utf-8"))
    camera = settings["gvdb_params"]
    mounting = settings["viewer_params_nodes"]["cam_in_body"]
    T_body_camera = np.array(mounting, dtype=np.float64).reshape(4, 4)
    shape = camera["rows"], camera["cols"]
    depth_m = [matrix(library / "data" / f"depth_{view}.bin", shape) for view in range(VIEWS)]
    bodies = [matrix(library / "data" / f"pose_{view}.bin", (4, 4)) for view in range(VIEWS)]
    tables = {name: noise(wrapper / "config" / "polys" / f"{name}.yml") for name in NOISE}
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        out / "clean_depth.npz",
        depth_m=np.stack(depth_m),
        T_world_camera=np.stack([T_world_body.astype(np.float64) @ T_body_camera for T_world_body in bodies]),
        K=np.array(camera["K"], dtype=np.float64).reshape(3, 3),
    )
    for name, table in tables.items():
        np.save(out / f"{name}.npy", table)


def matrix(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    """A matrix as Eigen's memory holds it: rows and columns as integers of 64 bits, then the values, column
    by column, as floats of 32 bits."""
    content = path.read_bytes()
    stated = tuple(np.frombuffer(content[:16], "<i8").tolist())
    values = content[16:]
    if stated != shape or len(values) != 4 * shape[0] * shape[1]:
        raise ValueError(f"{path} states {stated} and has {len(values)} bytes of values, not {shape}")
    return np.frombuffer(values, "<f4").reshape(shape, order="F")


def noise(path: Path) -> NDArray[np.float32]:
    """The coefficients of each patch, (patches, TERMS), from a list of all of them."""
    values = np.array(yaml.safe_load(path.read_text(encoding="utf-8")), dtype=np.float32)
    if values.ndim != 1 or len(values) % TERMS:
        raise ValueError(f"{path} holds no list of {TERMS} numbers a patch")
    return values.reshape(-1, TERMS)


if __name__ == "__main__":
    main()
