"""``--reading surface``: files and pictures of what the rays say."""

from pathlib import Path

import numpy as np
import pytest
from console import carry_out
from one_pixel import VOXEL
from uncertain_wall import uncertain_wall

from taichi_mrf.cli.options.map import Map
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.system import runtime

pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_map_is_exported_as_the_rays_read_it(tmp_path: Path) -> None:
    m = uncertain_wall()
    m.save(tmp_path / "map.npz")
    surface = ("--reading", "surface", "--arch", runtime.active() or "cpu")
    assert carry_out("export", tmp_path / "map.npz", "--to", tmp_path / "a.npz", *surface) == 0
    with np.load(tmp_path / "a.npz") as file:
        centres = (file["voxels"] + 0.5) * float(file["voxel_size"])
        np.testing.assert_array_equal(file["state"], m.reading("surface").state(centres))
    LogOddsMap(VOXEL).save(tmp_path / "log_odds.npz")
    for name, flags in (("log_odds.npz", ()), ("map.npz", ("--layer", "static"))):
        with pytest.raises(ConfigError, match="--reading surface"):
            carry_out("export", tmp_path / name, "--to", tmp_path / "b.npz", *surface, *flags)


def test_a_run_shows_the_map_as_the_rays_read_it(tmp_path: Path) -> None:
    room = "synthetic:room?frames=1&width=32&height=24"
    surface = ("--reading", "surface", "--runtime.arch", runtime.active() or "cpu", "--quiet")
    assert carry_out("map", room, "--out", tmp_path / "run", "--voxel-size", 0.2, *surface) == 0
    assert (tmp_path / "run" / "surface.png").stat().st_size > 0
    m = load_map(tmp_path / "run" / "map.npz")
    called = len(m.reading("surface").voxels()[0])
    assert called > len(m.voxels()[0])
    assert f"element vertex {called}\n".encode() in (tmp_path / "run" / "voxels.ply").read_bytes()
    with pytest.raises(ConfigError, match="--reading surface needs the method mrf"):
        Map(sources=(room,), out=tmp_path, shown_reading="surface", settings=Config(method="log_odds"))
