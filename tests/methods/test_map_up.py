"""A map keeps which way is up, whatever becomes of its keyframes, and files keep it too."""

import json
from pathlib import Path

import numpy as np
import pytest
from console import carry_out

from taichi_mrf.config.registry import METHODS
from taichi_mrf.errors import MapFileError
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.geometry.up import Up
from taichi_mrf.methods.brick_map import BrickMap
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.box import slice_map
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import MANIFEST

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(40, 30, 35.0, 35.0, 19.5, 14.5)
DEPTH_M = np.full(CAMERA.shape, 1.5, np.float32)
Y_DOWN: Up = (1, -1)
"""Up in a world that is the first camera's frame."""

UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0, 1.0])


def y_down(method: str) -> BrickMap:
    """A map whose first keyframe, now removed, had the world's y pointing down; its second hung head over."""
    m = METHODS[method].load_class()(0.2)
    first = m.add_keyframe(DEPTH_M, np.eye(4), CAMERA)
    m.add_keyframe(DEPTH_M, UPSIDE_DOWN, CAMERA)
    m.remove_keyframe(first)
    m.infer()
    return m


@pytest.mark.parametrize("method", METHODS)
def test_a_map_file_keeps_up(method: str, tmp_path: Path) -> None:
    assert METHODS[method].load_class()(0.2).up is None
    m = y_down(method)
    assert m.up == Y_DOWN
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.up == Y_DOWN
    assert slice_map(loaded, 0.0).axis == "y"
    assert "up is -y" in str(export_note(loaded, "floor.pgm"))


def test_frozen_keyframes_leave_their_up(tmp_path: Path) -> None:
    m = y_down("mrf")
    m.freeze_keyframe(next(iter(m.keyframes)))
    assert not m.keyframes
    m.save(tmp_path / "map.npz")
    assert load_map(tmp_path / "map.npz").up == Y_DOWN


def test_a_file_without_up_takes_it_from_its_first_keyframe(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    y_down("log_odds").save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in (MANIFEST, "up")}
    write_npz(path, arrays, manifest=True)
    assert load_map(path).up == (1, 1)
    write_npz(path, arrays | {"up": np.asarray("w")}, manifest=True)
    with pytest.raises(MapFileError, match="up is 'w'"):
        load_map(path)


def test_a_map_in_chunks_keeps_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("zarr", reason="maps in chunks need the extra store")
    y_down("mrf").save(tmp_path / "map.npz")
    command = ["export", tmp_path / "map.npz", "--arch", runtime.active() or "cpu", "--to"]
    assert carry_out(*command, tmp_path / "map.zarr") == 0
    part = take_part(ChunkedMap.open(tmp_path / "map.zarr"))
    assert part.up == Y_DOWN
    assert slice_map(part, 0.0).axis == "y"
    capsys.readouterr()
    assert carry_out("info", tmp_path / "map.zarr", "--json") == 0
    assert json.loads(capsys.readouterr().out)["up"] == "-y"
    assert carry_out(*command, tmp_path / "x.zarr", "--up", "x") == 0
    assert ChunkedMap.open(tmp_path / "x.zarr").up == (0, 1)


def test_a_store_of_an_earlier_version_has_no_up_and_shows_z(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="maps in chunks need the extra store")
    path = tmp_path / "map.zarr"
    export_map(y_down("mrf"), path)
    document = json.loads((path / "zarr.json").read_text())
    for up in ("w", 3):
        document["attributes"]["up"] = up
        (path / "zarr.json").write_text(json.dumps(document))
        with pytest.raises(MapFileError, match="up is"):
            ChunkedMap.open(path)
    del document["attributes"]["up"]
    (path / "zarr.json").write_text(json.dumps(document))
    part = take_part(ChunkedMap.open(path))
    assert part.up is None
    assert slice_map(part, 0.0).axis == "z"
    assert "assumed: the map does not hold which way is up" in str(export_note(part, "floor.pgm"))
    assert "(--up)" in str(export_note(part, "floor.pgm", ExportOptions(up="-y")))
