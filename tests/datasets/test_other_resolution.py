"""Intrinsics of images of another size are named, with the flag that fits, in every format."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    Content,
    K,
    arrays,
    text_of,
    write_npz,
    write_numbered,
    write_replica,
    write_rows,
    write_scannet,
    write_seven_scenes,
    write_tum,
)

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import TaichiMRFError

DOUBLE = np.diag([2.0, 2.0, 1.0]) @ K
"""Of images of 31 x 23 pixels or so."""
CONTENT = Content(2)


def with_matrix(write: Callable[[Path, Content], Path]) -> Callable[[Path, np.ndarray], Path]:
    def layout(folder: Path, matrix: np.ndarray) -> Path:
        write(folder, CONTENT)
        (folder / "camera.txt").unlink()
        (folder / "K.txt").write_text(text_of(matrix))
        return folder

    return layout


def numbered(folder: Path, content: Content) -> Path:
    write_rows(write_numbered(folder, content) / "poses.txt", content.poses)
    return folder


def scannet(folder: Path, matrix: np.ndarray) -> Path:
    write_scannet(folder, CONTENT)
    (folder / "intrinsic/intrinsic_depth.txt").write_text(text_of(matrix))
    return folder


def npz(folder: Path, matrix: np.ndarray) -> Path:
    return write_npz(folder.with_suffix(".npz"), arrays(CONTENT) | {"K": matrix})


@pytest.mark.parametrize(
    "layout",
    [*map(with_matrix, (write_seven_scenes, write_tum, numbered)), scannet, npz],
    ids=["seven_scenes", "tum", "numbered", "scannet", "npz"],
)
def test_a_matrix_of_another_size(tmp_path: Path, layout: Callable[[Path, np.ndarray], Path]) -> None:
    path = layout(tmp_path / "walk", DOUBLE)
    said = (
        r"images of about 31 x 23 pixels, .*images have 16 x 12: scaled to these they are [\d.,]+; --camera"
    )
    with pytest.raises(TaichiMRFError, match=said) as caught:
        open_dataset(path)
    fits = str(caught.value).split("they are ")[1].split(";")[0].split(",")
    np.testing.assert_allclose(np.array(fits, float), [14.0, 15.0, 7.5, 5.5], rtol=0.05)
    assert open_dataset(path, intrinsics=tuple(map(float, fits))).read(0).camera.shape == (12, 16)  # type: ignore[arg-type]
    with pytest.raises(TaichiMRFError, match="pass the intrinsics of these images: --camera fx,fy,cx,cy"):
        open_dataset(layout(tmp_path / "wide", np.diag([2.0, 3.0, 1.0]) @ K))


def test_a_camera_with_its_size(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", CONTENT)
    (folder / "camera.txt").write_text("32 24 28 30 15.5 11.5")
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 14,15,7\.5,5\.5"):
        open_dataset(folder).read(0)
    (folder / "camera.txt").unlink()
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 13\.125,13\.125,"):
        open_dataset(folder)
    write_replica(tmp_path / "replica", CONTENT, tmp_path / "cam_params.json")
    (tmp_path / "cam_params.json").write_text(
        (tmp_path / "cam_params.json").read_text().replace('"w": 16, "h": 12', '"w": 32, "h": 24')
    )
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 7,7\.5,3\.5,2\.5"):
        open_dataset(tmp_path / "replica")
