"""``map --color``: colours from the recording to the files, and where there are none."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from console import FAST, carry_out

from taichi_mrf.datasets.summary import UNUSED_COLOR
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.ply import photo_at
from taichi_mrf.methods.registry import load_map
from taichi_mrf.voxels.colors import MARGINAL_NOTE, PHOTO_NOTE

pytestmark = pytest.mark.usefixtures("one_backend")

ROOM = "synthetic:room?width=80&height=60&frames=4"
MAP = ("map", ROOM, *FAST, "--evaluation.hold-out", "0")


def test_colours_go_from_the_images_into_the_files(tmp_path: Path) -> None:
    assert carry_out(*MAP, "--color", "--out", tmp_path / "run") == 0
    m = load_map(tmp_path / "run" / "map.npz")
    centres, _ = m.decided.voxels(0.5)
    cloud = trimesh.load(tmp_path / "run" / "voxels.ply")
    np.testing.assert_array_equal(cloud.colors[:, :3], photo_at(m, centres))
    assert len(np.unique(cloud.colors, axis=0)) > 50
    for by, note in (("photo", PHOTO_NOTE), ("marginal", MARGINAL_NOTE)):
        to = tmp_path / f"{by}.ply"
        assert carry_out("export", tmp_path / "run" / "map.npz", "--to", to, "--color-by", by) == 0
        assert note.encode() in to.read_bytes()[:500]


def test_what_has_no_colours_refuses_them(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="color needs the method"):
        carry_out(*MAP, "--color", "--method", "log_odds", "--out", tmp_path / "run")


def test_unused_colours_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert carry_out("info", ROOM, "--json") == 0
    assert UNUSED_COLOR in json.loads(capsys.readouterr().out)["notes"]
    runs = {
        "plain": (),
        "colored": ("--color",),
        "log_odds": ("--method", "log_odds"),
    }
    for name, flags in runs.items():
        assert carry_out(*MAP, "--limit", "1", "--no-pictures", *flags, "--out", tmp_path / name) == 0
        notes = json.loads((tmp_path / name / "report.json").read_text("utf-8"))["notes"]
        assert (UNUSED_COLOR in notes) == (name == "plain"), name
