"""data/tiny_room is small, is what its script makes, and is the room that it claims to be."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.room_furniture import room_scene


@pytest.fixture(scope="module")
def remade(one_backend: str, repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sequence as the script makes it here."""
    script, folder = (
        repository / "data" / "make_tiny_sequence.py",
        tmp_path_factory.mktemp("data") / "tiny_room",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(script), str(folder)])
        runpy.run_path(str(script), run_name="__main__")
    return folder


def test_it_is_small_and_a_dozen(repository: Path) -> None:
    folder = repository / "data" / "tiny_room"
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 1_000_000
    dataset = open_dataset(folder)
    assert len(dataset) == 12
    assert dataset.dropped == 0
    assert dataset.notes == []
    assert dataset.camera.shape == (240, 320)


def test_its_points_lie_on_the_rooms_surfaces(repository: Path) -> None:
    scene = room_scene()
    for frame in open_dataset(repository / "data" / "tiny_room"):
        assert frame.color is not None
        seen = frame.depth_m > 0
        assert seen.mean() > 0.8
        z = frame.depth_m[seen].astype(np.float64)
        points = frame.camera.rays()[seen] * z[:, None] @ frame.T_world_camera[:3, :3].T
        distance = np.abs(scene.signed_distance(points + frame.T_world_camera[:3, 3]))
        sigma = np.hypot(0.001504 - 0.00152 * z + 0.0019 * z**2, 0.00285 * z**2 / np.sqrt(12))
        assert (distance < 3 * sigma + 1e-4).mean() > 0.99  # 3 sigma hold 99.7% of a normal distribution


def test_the_script_makes_it_again(repository: Path, remade: Path) -> None:
    kept, made = open_dataset(repository / "data" / "tiny_room"), open_dataset(remade)
    assert kept.frame_names == made.frame_names
    assert kept.camera == made.camera
    for a, b in zip(kept, made, strict=True):
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-8)
        # Another processor may round a ray to the other side of an edge or of a step of disparity.
        assert (np.abs(a.depth_m - b.depth_m) > 1e-3).mean() < 1e-3
