"""Frames whose recording stores intrinsics for each have cameras of their own, in every format."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    INTRINSIC,
    Content,
    K,
    arrays,
    column_by_column,
    text_of,
    write_image,
    write_npz,
    write_numbered,
    write_record3d,
    write_scannet,
    write_stray,
)

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import inverse

CONTENT = Content(4)
FOCAL = [14.0, 0.0, 21.0, 20.0]
"""Of each frame; zero: not known."""


def matrices(sizes: float = 1.0) -> list[np.ndarray]:
    found = [K.copy() for _ in FOCAL]
    for focal, matrix in zip(FOCAL, found, strict=True):
        matrix[:2] *= focal > 0
        matrix[0, 0] = matrix[1, 1] = focal * sizes
    return found


def open3d(folder: Path) -> Path:
    write_numbered(folder, CONTENT)
    (folder / "camera.txt").unlink()
    entries = [
        {
            "extrinsic": column_by_column(inverse(pose)),
            "intrinsic": INTRINSIC | {"intrinsic_matrix": column_by_column(matrix)},
        }
        for pose, matrix in zip(CONTENT.poses, matrices(), strict=True)
    ]
    trajectory = {"class_name": "PinholeCameraTrajectory", "parameters": entries}
    (folder / "trajectory.json").write_text(json.dumps(trajectory))
    return folder


def npz(folder: Path) -> Path:
    return write_npz(folder.with_suffix(".npz"), arrays(CONTENT) | {"K": np.array(matrices())})


def npz_by_name(folder: Path) -> Path:
    values = arrays(CONTENT) | {"fx": np.array(FOCAL), "fy": np.array(FOCAL)}
    del values["K"]
    center = {name: np.where(np.array(FOCAL) > 0, at, 0) for name, at in (("cx", 7.5), ("cy", 5.5))}
    return write_npz(folder.with_suffix(".npz"), values | center)


def scannet(folder: Path) -> Path:
    write_scannet(folder, CONTENT)
    for i, matrix in enumerate(matrices()):
        (folder / f"intrinsic/{5 * i}.txt").write_text(text_of(matrix))
    return folder


def record3d(folder: Path) -> Path:
    coefficients = [[2 * focal, 2 * focal, 15.5 * (focal > 0), 11.5 * (focal > 0)] for focal in FOCAL]
    return write_record3d(folder, CONTENT, perFrameIntrinsicCoeffs=coefficients)


def stray(folder: Path) -> Path:
    write_stray(folder, CONTENT)
    head, *lines = (folder / "odometry.csv").read_text().splitlines()
    own = (
        f"{line}, {7.5 * focal}, {7.5 * focal}, 960, 720" for line, focal in zip(lines, FOCAL, strict=True)
    )
    (folder / "odometry.csv").write_text("\n".join([f"{head}, fx, fy, cx, cy", *own]))
    return folder


@pytest.mark.parametrize("layout", [open3d, npz, npz_by_name, scannet, record3d, stray])
def test_each_frame_has_its_own_camera(tmp_path: Path, layout: Callable[[Path], Path]) -> None:
    path = layout(tmp_path / "walk")
    dataset = open_dataset(path)
    focal = [frame.camera.fx for frame in dataset]  # type: ignore[attr-defined]
    assert focal == pytest.approx([14.0, 14.0, 21.0, 20.0])
    assert dataset.camera == dataset.read(0).camera
    given = open_dataset(path, intrinsics=(30.0, 30.0, 7.0, 5.0))
    assert {frame.camera.fx for frame in given} == {30.0}  # type: ignore[attr-defined]


def test_a_change_of_resolution_is_a_change_of_camera(tmp_path: Path) -> None:
    folder = scannet(tmp_path / "walk")
    wide = np.kron(CONTENT.depth[2], np.ones((2, 2), np.uint16))
    write_image(folder / "depth/10.png", wide)
    (folder / "intrinsic/10.txt").write_text(text_of(np.diag([2.0, 2, 1]) @ K))
    assert [frame.camera.shape for frame in open_dataset(folder)] == [(12, 16)] * 2 + [(24, 32), (12, 16)]
    (folder / "intrinsic/10.txt").unlink()
    (folder / "intrinsic/0.txt").unlink()
    for number in (5, 15):
        (folder / f"intrinsic/{number}.txt").unlink()
    with pytest.raises(
        FrameError, match=r"^frame 10: .*10.png: the image has 32 x 24 pixels, the camera 16 x 12"
    ):
        list(open_dataset(folder))


def test_files_of_several_cameras(tmp_path: Path) -> None:
    values = arrays(Content(2))
    write_npz(tmp_path / "a.npz", values)
    wide = Content(2, (24, 32))
    write_npz(tmp_path / "b.npz", arrays(wide) | {"K": np.diag([2.0, 2, 1]) @ K})
    assert [frame.camera.shape for frame in open_dataset(tmp_path)] == [(12, 16)] * 2 + [(24, 32)] * 2


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"K": np.zeros((3, 3, 3))}, r"K is \(3, 3, 3\); expected \(3, 3\), or \(4, 3, 3\)"),
        ({"K": np.zeros((4, 3, 3))}, "intrinsics are all zero; --camera"),
        ({"K": np.array([K, K, -K, K])}, "K of frame 2: not the matrix of a pinhole camera"),
    ],
)
def test_wrong_matrices_are_named(tmp_path: Path, change: dict[str, np.ndarray], problem: str) -> None:
    with pytest.raises(DatasetError, match=problem):
        open_dataset(write_npz(tmp_path / "a.npz", arrays(CONTENT) | change))
