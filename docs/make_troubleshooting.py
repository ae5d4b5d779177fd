"""Makes the pictures of docs/troubleshooting.md: a recording with one mistake, mapped as it is and with the
flag that mends it.

    python docs/make_troubleshooting.py
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import taichi_mrf as tm

IMAGES = Path(__file__).resolve().parent / "images"
ROOM = "synthetic:room?frames=16&width=160&height=120"
WIDTH = 430
"""Columns of each of the two pictures side by side."""

Mistake = Callable[[tm.Frame], tm.Frame]


def inverse(frame: tm.Frame) -> tm.Frame:
    """The pose of the world in the camera."""
    return replace(frame, T_world_camera=np.linalg.inv(frame.T_world_camera))


def opengl(frame: tm.Frame) -> tm.Frame:
    """The pose of the same camera with y up and z back."""
    return replace(frame, T_world_camera=frame.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))


def ranges(frame: tm.Frame) -> tm.Frame:
    """The distance along each pixel's ray in place of the depth along the optical axis."""
    along = np.linalg.norm(frame.camera.rays(), axis=-1)
    return replace(frame, depth_m=(frame.depth_m * along).astype(np.float32))


def shaken(frame: tm.Frame) -> tm.Frame:
    """A pose that is off by 2 cm along and 1 degree about each axis (standard deviations)."""
    random = np.random.default_rng(round(1000 * frame.stamp))
    T = frame.T_world_camera.copy()
    x, y, z = np.radians(random.normal(size=3))
    T[:3, :3] = T[:3, :3] @ (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    T[:3, 3] += random.normal(scale=0.02, size=3)
    return replace(frame, T_world_camera=T)


PICTURES: dict[str, tuple[Mistake, list[str]]] = {
    "trouble_inverse.jpg": (inverse, ["--poses-are", "inverse"]),
    "trouble_opengl.jpg": (opengl, ["--poses-are", "opengl"]),
    "trouble_range.jpg": (ranges, ["--depth-is", "range"]),
    "trouble_shaken.jpg": (shaken, ["--refine-poses"]),
}
"""The mistake of each picture's recording, and the flag."""


def main() -> None:
    """Make all of them."""
    tm.init("cpu")
    frames = list(tm.open_dataset(ROOM))
    for name, (mistake, flags) in PICTURES.items():
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder) / "walk.npz"
            write(recording, [mistake(frame) for frame in frames])
            folders = (("as", []), ("mended", flags))
            pair = [picture(recording, Path(folder) / out, given) for out, given in folders]
        height = max(each.height for each in pair)
        both = Image.new("RGB", (2 * WIDTH + 8, height), "white")
        for number, each in enumerate(pair):
            both.paste(each, (number * (WIDTH + 8), 0))
        both.save(IMAGES / name, quality=60)
        print(IMAGES / name)


def write(path: Path, frames: list[tm.Frame]) -> None:
    """A recording as data/README.md has it."""
    k = frames[0].camera
    np.savez(
        path,
        depth_m=np.stack([frame.depth_m for frame in frames]),
        T_world_camera=np.stack([frame.T_world_camera for frame in frames]),
        K=np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]),
        stamp=np.array([frame.stamp for frame in frames]),
    )


def picture(recording: Path, out: Path, flags: list[str]) -> Image.Image:
    """The surface of the recording's map."""
    command = [sys.executable, "-m", "taichi_mrf", "map", str(recording), "--out", str(out), *flags]
    subprocess.run([*command, "--noise", "given", "--quiet"], check=True)
    drawn = Image.open(out / "surface.png").convert("RGB")
    return drawn.resize((WIDTH, round(WIDTH * drawn.height / drawn.width)))


if __name__ == "__main__":
    main()
