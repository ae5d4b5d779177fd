"""Makes data/tiny_room: a dozen frames of the synthetic room in TUM RGB-D layout, under 1 MB.

Run it with ``python data/make_tiny_sequence.py [FOLDER]``. The depth has the simulated noise of a Kinect 1,
whose coarse steps of disparity are also what lets the PNGs become small.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np

import taichi_mrf
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.formats.tum_rgbd import COLOR_LIST, DEPTH_LIST, POSES, STEPS_PER_METRE
from taichi_mrf.geometry.poses import Pose

SOURCE = "synthetic:room?frames=12&width=320&height=240&noise=kinect&seed=0"
LARGEST = 1_000_000
"""Bytes that the whole folder may take, since it lies in the repository."""


def main() -> None:
    """Render the sequence into the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Render the tiny sequence of the synthetic room.")
    default = Path(__file__).parent / "tiny_room"
    parser.add_argument("folder", type=Path, nargs="?", default=default, help="where to write it")
    folder = parser.parse_args().folder
    taichi_mrf.init("cpu")
    unfinished = folder.with_name(folder.name + ".part")
    shutil.rmtree(unfinished, ignore_errors=True)
    write_tum_sequence(open_dataset(SOURCE), unfinished)
    size = sum(path.stat().st_size for path in unfinished.rglob("*") if path.is_file())
    if size > LARGEST:
        raise SystemExit(f"{unfinished}: {size} bytes, more than {LARGEST}")
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)
    print(f"{folder}: {size} bytes")


def write_tum_sequence(dataset: Dataset, folder: Path) -> None:
    """Write all frames of a data set, with colour where they have it, in TUM RGB-D layout."""
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    depth_lines, color_lines, pose_lines = (
        ["# stamp file"],
        ["# stamp file"],
        ["# stamp tx ty tz qx qy qz qw"],
    )
    for frame in dataset:
        stamp = f"{frame.stamp:.6f}"
        steps = np.round(frame.depth_m * STEPS_PER_METRE)
        too_far = steps > np.iinfo(np.uint16).max
        depth = np.where(too_far, 0, steps).astype(np.uint16)
        _write_image(folder / "depth" / f"{stamp}.png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        depth_lines.append(f"{stamp} depth/{stamp}.png")
        if frame.color is not None:
            bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
            _write_image(folder / "rgb" / f"{stamp}.jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])
            color_lines.append(f"{stamp} rgb/{stamp}.jpg")
        numbers = (*frame.T_world_camera[:3, 3], *quaternion(frame.T_world_camera))
        pose_lines.append(" ".join([stamp, *(f"{number:.9f}" for number in numbers)]))
    for name, lines in ((DEPTH_LIST, depth_lines), (COLOR_LIST, color_lines), (POSES, pose_lines)):
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    k = dataset.camera
    text = f"# width height fx fy cx cy\n{k.width} {k.height} {k.fx} {k.fy} {k.cx} {k.cy}\n"
    (folder / "camera.txt").write_text(text, encoding="utf-8")


def quaternion(T: Pose) -> np.ndarray:
    """The unit quaternion x y z w, with w not negative, of a pose's rotation.

    It is the eigenvector to the largest eigenvalue of a matrix that is linear in R (Bar-Itzhack 2000),
    which is well conditioned for every rotation.
    """
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3]
    matrix = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    q = np.linalg.eigh(matrix)[1][:, -1]
    return q if q[3] >= 0 else -q


def _write_image(path: Path, image: np.ndarray, options: list[int]) -> None:
    ok, data = cv2.imencode(path.suffix, image, options)
    if not ok:
        raise SystemExit(f"{path}: the image cannot be encoded")
    path.write_bytes(data.tobytes())


if __name__ == "__main__":
    main()
