"""Voxels as a PLY file that another library reads back."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from taichi_mrf.errors import MapFileError
from taichi_mrf.export.ply import write_voxels
from taichi_mrf.voxels.colors import marginal_colors, viridis


def _read(path: Path) -> dict:
    """Vertex data as trimesh's own PLY parser sees it."""
    with open(path, "rb") as file:
        return trimesh.exchange.ply.load_ply(file)


def test_voxels_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    centres = rng.uniform(-30, 30, (1234, 3))
    probability = rng.uniform(0.5, 1.0, 1234).astype(np.float32)
    write_voxels(tmp_path / "voxels.ply", centres, probability, 0.02)
    cloud = trimesh.load(tmp_path / "voxels.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(cloud.vertices, centres.astype(np.float32))
    np.testing.assert_array_equal(cloud.colors[:, :3], marginal_colors(probability))
    data = _read(tmp_path / "voxels.ply")["metadata"]["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.asarray(data["occupancy"]).ravel(), probability)


def test_header_says_voxel_size(tmp_path: Path) -> None:
    write_voxels(tmp_path / "v.ply", np.zeros((1, 3)), np.ones(1), 0.05)
    header = (tmp_path / "v.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment voxel_size 0.05 metres" in header
    assert "property float occupancy" in header


def test_empty_map(tmp_path: Path) -> None:
    write_voxels(tmp_path / "v.ply", np.zeros((0, 3)), np.zeros(0), 0.05)
    content = (tmp_path / "v.ply").read_bytes()
    assert b"element vertex 0\n" in content
    assert content.endswith(b"end_header\n")
    assert _read(tmp_path / "v.ply")["metadata"]["_ply_raw"]["vertex"]["length"] == 0


def test_unwritable(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"v\.ply: cannot be written"):
        write_voxels(tmp_path / "absent" / "v.ply", np.zeros((1, 3)), np.ones(1), 0.05)


def test_colors_are_matplotlibs_viridis() -> None:
    from matplotlib import colormaps

    expected = colormaps["viridis"](np.arange(256), bytes=True)[:, :3].astype(int)
    assert np.abs(viridis().astype(int) - expected).max() <= 1
    np.testing.assert_array_equal(marginal_colors([0.2, 0.5]), viridis()[[0, 0]])
    np.testing.assert_array_equal(marginal_colors([[1.0], [0.75]])[:, 0], viridis()[[255, 128]])
