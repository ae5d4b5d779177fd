"""Files and pictures of the command line call occupied what the rays say."""

from pathlib import Path

import numpy as np
import pytest
from console import carry_out
from uncertain_wall import uncertain_wall

from taichi_mrf.methods.registry import load_map
from taichi_mrf.system import runtime

pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_map_is_exported_by_what_is_occupied(tmp_path: Path) -> None:
    m = uncertain_wall()
    m.save(tmp_path / "map.npz")
    arch = ("--arch", runtime.active() or "cpu")
    assert carry_out("export", tmp_path / "map.npz", "--to", tmp_path / "a.npz", *arch) == 0
    with np.load(tmp_path / "a.npz") as file:
        centres = (file["voxels"] + 0.5) * float(file["voxel_size"])
        np.testing.assert_array_equal(file["state"], m.state(centres))
        np.testing.assert_array_equal(file["probability"], m.occupancy(centres))
    assert (m.state(centres) != m.marginals.state(centres)).any()


def test_a_run_writes_the_occupied_voxels(tmp_path: Path) -> None:
    room = "synthetic:room?frames=1&width=32&height=24"
    flags = ("--runtime.arch", runtime.active() or "cpu", "--quiet")
    assert carry_out("map", room, "--out", tmp_path / "run", "--voxel-size", 0.2, *flags) == 0
    assert (tmp_path / "run" / "surface.png").stat().st_size > 0
    m = load_map(tmp_path / "run" / "map.npz")
    called = len(m.voxels()[0])
    assert called > len(m.marginals.voxels()[0])
    assert f"element vertex {called}\n".encode() in (tmp_path / "run" / "voxels.ply").read_bytes()
