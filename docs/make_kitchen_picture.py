"""Makes docs/images/kitchen.jpg: the coloured mesh of a kitchen in voxels of 1 cm, as a photograph of it.

    python docs/make_kitchen_picture.py FOLDER

FOLDER is 7-Scenes' red kitchen (Shotton et al., CVPR 2013), every tenth frame of one sequence, which is not
part of this repository. The kitchen is mapped on the command line, and ``m.surface()`` is drawn in the
colours of its vertices. Nothing is retouched: light and shadow are those of the photographs, and what no
camera has measured is left out. Needs the extra ``mesh`` and Pillow.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from embreex import mesh_construction, rtcore_scene
from make_pictures import IMAGES, REPOSITORY, write
from numpy.typing import NDArray
from PIL import Image

import taichi_mrf
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera

MAP = ("--voxel-size", "0.01", "--color", "--evaluation.hold-out", "0", "--no-pictures")

SIZE = (1200, 590)
RAYS = 3
"""Rays of a pixel along each side."""

FOCAL = 600.0
EYE, TARGET, UP = (0.33, -0.45, 0.44), (-0.30, -0.15, 2.5), (0.0, -1.0, 0.0)
"""In metres, in the frame of the first camera. No frame was taken from there."""

BACKGROUND = (236, 236, 234)


def main() -> None:
    """Map, make the surface, draw."""
    if len(sys.argv) != 2:
        sys.exit("usage: python docs/make_kitchen_picture.py FOLDER")
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "taichi_mrf", "map", sys.argv[1], "--out", folder, *MAP]
        subprocess.run(words, cwd=REPOSITORY, check=True)
        m = taichi_mrf.load_map(Path(folder, "map.npz"))
    write(drawn(m.surface()), IMAGES / "kitchen.jpg")


def drawn(surface: FusedSurface) -> Image.Image:
    """The surface in the colours of its vertices."""
    width, height = SIZE[0] * RAYS, SIZE[1] * RAYS
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    camera = PinholeCamera(width, height, FOCAL * RAYS, FOCAL * RAYS, *middle)
    pose = look_at(EYE, TARGET, UP)
    scene = rtcore_scene.EmbreeScene(robust=True)
    triangles = np.ascontiguousarray(surface.triangles, np.int32)
    mesh_construction.TriangleMesh(scene, np.ascontiguousarray(surface.vertices_m, np.float32), triangles)
    directions = (camera.rays().reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
    origins = np.tile(pose[:3, 3].astype(np.float32), (len(directions), 1))
    hit = scene.run(origins, directions, query="INTERSECT", output=True)
    found = hit["primID"] >= 0
    picture: NDArray[np.float64] = np.tile(np.array(BACKGROUND, np.float64), (len(directions), 1))
    u, v = hit["u"][found], hit["v"][found]
    share = np.stack([1.0 - u - v, u, v], axis=1)
    assert surface.colors is not None
    colors = surface.colors.astype(np.float64)[triangles[hit["primID"][found]]]
    picture[found] = np.einsum("nij,ni->nj", colors, share)
    blocks = picture.reshape(SIZE[1], RAYS, SIZE[0], RAYS, 3)
    return Image.fromarray(np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8))


if __name__ == "__main__":
    main()
