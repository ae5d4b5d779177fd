"""``taichi-mrf export``: every format of every kind of map, read back by other programs."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from browser import LivePage, chromium, missing
from console import carry_out
from queried_maps import hand_map, map_of, room_map

from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.formats import FORMATS, export_map, export_note
from taichi_mrf.export.map_server import level_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.queries.cells import standing_cells
from taichi_mrf.queries.known_bricks import bricks_between, seen_free_bricks
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import BRICK

pytestmark = pytest.mark.usefixtures("one_backend")

METHODS = ["mrf", "log_odds", "visibility"]
BAND = {"z_min": -0.9, "z_max": 0.3}


@pytest.fixture(scope="module")
def saved(backend: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("saved")
    for method in METHODS:
        room_map(method).save(folder / f"{method}.npz")
    return {method: folder / f"{method}.npz" for method in METHODS}


def run_export(*arguments: object) -> int:
    arch = runtime.active() or "cpu"
    return carry_out("export", *arguments, "--arch", arch)


@pytest.mark.parametrize(
    ("second", "error"),
    [
        (["b.pgm"], ConfigError),  # without a band of heights
        (
            ["b.stl", "--surface", "marginal", "--threshold", "0.9999999"],
            ConfigError,
        ),  # no voxel is that sure
        (["a/b.pgm"], ConfigError),  # nor is its folder made
        (["text/b.bt"], MapFileError),  # in a file
        (["a.ply"], ConfigError),  # twice
        (["folder.npz"], MapFileError),
    ],
)
def test_if_one_file_cannot_be_made_none_is_written(
    saved: dict[str, Path], tmp_path: Path, second: list[str], error: type[Exception]
) -> None:
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "text").touch()
    name, *flags = second
    with pytest.raises(error) as caught:
        run_export(saved["mrf"], "--to", tmp_path / "a.ply", tmp_path / name, *flags)
    assert ".export-" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"folder.npz", "text"}


def test_the_folder_of_a_file_is_made(saved: dict[str, Path], tmp_path: Path) -> None:
    store, points = tmp_path / "a" / "b" / "map.zarr", tmp_path / "a" / "c.ply"
    assert run_export(saved["mrf"], "--to", store, points) == 0
    assert store.is_dir()
    assert points.is_file()
    assert not list(tmp_path.glob("**/.export-*"))


@pytest.mark.parametrize("method", METHODS)
def test_all_formats_of_a_saved_map(
    saved: dict[str, Path], method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"map{extension}" for extension in FORMATS if extension != ".yaml"]
    files = [tmp_path / name for name in names]
    assert run_export(saved[method], "--to", *files, "--z-min=-0.9", "--z-max", "0.3", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    written = {Path(each["file"]).name: each["bytes"] for each in report}
    assert set(written) == {*names, "map.yaml"}
    assert {path.name: size_of(path) for path in tmp_path.iterdir()} == written


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def test_points_are_the_voxels(tmp_path: Path) -> None:
    m = room_map("mrf")
    export_map(m, tmp_path / "map.ply", ExportOptions(threshold=0.8, cells=False))
    cloud = trimesh.load(tmp_path / "map.ply")
    np.testing.assert_array_equal(cloud.vertices, m.decided.voxels(0.8)[0].astype(np.float32))
    assert 0 < len(cloud.vertices) < len(m.decided.voxels(0.5)[0])


def test_cells_that_stand_in_for_voxels_are_points_with_their_size(tmp_path: Path) -> None:
    m = room_map("mrf")
    export_map(m, tmp_path / "map.ply", ExportOptions(threshold=0.8))
    with open(tmp_path / "map.ply", "rb") as file:
        table = trimesh.exchange.ply.load_ply(file)["metadata"]["_ply_raw"]["vertex"]["data"]
    sides, counts = np.unique(np.rint(np.asarray(table["size"]) / m.voxel_size), return_counts=True)
    cells = {cells.side: len(cells) for cells in standing_cells(m.decided, 0.8) if len(cells)}
    assert dict(zip(sides, counts, strict=True)) == {1: len(m.decided.voxels(0.8)[0]), **cells}
    assert cells


@pytest.mark.parametrize("method", METHODS)
def test_arrays_hold_all_that_is_known(method: str, tmp_path: Path) -> None:
    m = room_map(method)
    export_map(m, tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        arrays: dict[str, Any] = dict(file)
    centres = (arrays["voxels"] + 0.5) * float(arrays["voxel_size"])
    np.testing.assert_array_equal(arrays["probability"], m.occupancy(centres))
    np.testing.assert_array_equal(arrays["state"], m.state(centres))
    assert set(np.unique(arrays["state"])) == {1, 2}
    np.testing.assert_array_equal(arrays["free_bricks"], seen_free_bricks(m))
    assert float(arrays["prior"]) == m.occupancy([[50.0, 50.0, 50.0]])[0]
    everywhere = bricks_between(np.full(3, -8), np.full(3, 7))
    inside = np.indices((BRICK,) * 3).reshape(3, -1).T
    voxels = (everywhere[:, None] * BRICK + inside).reshape(-1, 3)
    known = (m.state((voxels + 0.5) * 0.1) != 0).sum()
    assert known == len(centres) + BRICK**3 * len(arrays["free_bricks"])
    with pytest.raises(MapFileError, match="not a map of taichi_mrf"):
        load_map(tmp_path / "map.npz")


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_the_2d_map_says_what_stands_in_the_band(method: str, tmp_path: Path) -> None:
    m = room_map(method)
    written = export_map(m, tmp_path / "floor.pgm", ExportOptions(**BAND))
    assert written == [tmp_path / "floor.pgm", tmp_path / "floor.yaml"]
    image = cv2.imread(str(tmp_path / "floor.pgm"), cv2.IMREAD_UNCHANGED)
    described = yaml.safe_load((tmp_path / "floor.yaml").read_text())
    assert described["image"] == "floor.pgm"
    assert described["resolution"] == 0.1
    rows, columns = image.shape
    x = described["origin"][0] + (np.arange(columns) + 0.5) * 0.1
    y = described["origin"][1] + (rows - np.arange(rows) - 0.5) * 0.1
    z = np.arange(-0.85, 0.3, 0.1)
    points = np.stack(np.meshgrid(y, x, z, indexing="ij"), axis=-1)[..., [1, 0, 2]].reshape(-1, 3)
    state = m.state(points).reshape(rows, columns, len(z))
    wanted = np.where((state == 2).any(axis=2), 0, np.where((state == 1).any(axis=2), 254, 205))
    np.testing.assert_array_equal(image, wanted)
    assert all((image == grey).sum() > 100 for grey in (0, 205, 254))


def test_cells_between_the_thresholds_are_unknown(backend: str) -> None:
    log_odds = np.full((8, 8, 8), -9.0)
    log_odds[1], log_odds[2], log_odds[3] = 0.5, 2.0, -2.2  # likely, very likely, never seen
    m = map_of(backend, (0, 0, 0), log_odds)
    found = level_map(m, 0.1, 0.3, occupied_from=0.8, free_below=0.4)
    np.testing.assert_array_equal(found.state, np.tile([1, 0, 2, 0, 1, 1, 1, 1], (8, 1)))
    assert found.highest[0, 2] == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert (level_map(m, 0.1, 0.3).state[0, :4] == [1, 2, 2, 0]).all()


def test_the_2d_map_of_a_world_whose_y_points_down_is_a_floor_plan(backend: str, tmp_path: Path) -> None:
    m = replace(hand_map(backend), keyframes={0: SimpleNamespace(T_world_camera=np.eye(4))})
    export_map(m, tmp_path / "floor.pgm", ExportOptions(z_min=-1.6, z_max=-1.0))
    image = cv2.imread(str(tmp_path / "floor.pgm"), cv2.IMREAD_UNCHANGED)
    text = (tmp_path / "floor.yaml").read_text()
    assert text.startswith("# up is -y: columns run along x, rows from the bottom along z\n")
    described, size = yaml.safe_load(text), m.voxel_size
    rows, columns = image.shape
    x = described["origin"][0] + (np.arange(columns) + 0.5) * size
    z = described["origin"][1] + (rows - np.arange(rows) - 0.5) * size
    y = np.arange(1.0 + size / 2, 1.6, size)
    points = np.stack(np.meshgrid(z, x, y, indexing="ij"), axis=-1)[..., [1, 2, 0]].reshape(-1, 3)
    state = m.state(points).reshape(rows, columns, len(y))
    occupied = m.occupancy(points).reshape(state.shape) >= 0.5
    wanted = np.where((occupied & (state > 0)).any(axis=2), 0, np.where((state > 0).any(axis=2), 254, 205))
    np.testing.assert_array_equal(image, wanted)
    assert {0, 254} <= set(np.unique(image))
    sideways = ExportOptions(z_min=-1.6, z_max=-1.0, up="z")
    assert "(--up)" in str(export_note(m, "floor.pgm", sideways))
    assert "as in the map's first keyframe" in str(export_note(m, "floor.pgm"))
    assert export_note(m, "map.glb") is None


def test_a_2d_map_needs_a_band_in_which_something_is_known(tmp_path: Path) -> None:
    m = room_map("mrf")
    with pytest.raises(ConfigError, match=r"z_min and z_max; the map is known from -1\.\d\d m to 1\.\d\d m"):
        export_map(m, tmp_path / "floor.pgm", ExportOptions(z_min=0.0))
    with pytest.raises(
        ConfigError, match=r"nothing is known between z_min 7 m and z_max 8 m; the map is known"
    ):
        export_map(m, tmp_path / "floor.yaml", ExportOptions(z_min=7, z_max=8))
    assert not list(tmp_path.iterdir())


def test_the_page_stands_alone(tmp_path: Path) -> None:
    export_map(room_map("mrf"), tmp_path / "map.html")
    page = (tmp_path / "map.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    data = re.search(r'window\.__VISER_EMBED_DATA__="([A-Za-z0-9+/=]+)"', page)
    assert data is not None
    assert len(base64.b64decode(data.group(1))) > 10000
    assert not re.search(r'(src|href)="https?://', page)


@pytest.mark.skipif(missing() is not None, reason=str(missing()))
@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_a_browser_shows_the_voxels(method: str, tmp_path: Path) -> None:
    m = room_map(method)
    export_map(m, tmp_path / "map.html")
    with chromium() as browser, LivePage(browser, (tmp_path / "map.html").as_uri()) as page:
        seen = page.until(lambda seen: seen.voxels, "voxels in the scene")
        assert seen.voxels == len(m.decided.voxels(0.5)[0])
        expected = sum(len(cells) for cells in standing_cells(m.decided))
        assert any(node.startswith("/cells/") for node in seen.nodes) == (expected > 0)
        assert page.problems == []


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("map.plyy", "unknown export format .plyy; did you mean .ply?"),
        ("map.oct", "unknown export format .oct; did you mean .ot?"),
        ("map.html5", "did you mean .html?"),
        ("map", "no file extension: cannot choose an export format"),
    ],
)
def test_names_that_no_format_has(saved: dict[str, Path], name: str, problem: str, tmp_path: Path) -> None:
    """Nothing is written then, be it for the other names."""
    with pytest.raises(ConfigError, match=re.escape(problem)):
        run_export(saved["log_odds"], "--to", tmp_path / "map.ply", tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_the_map_is_not_overwritten(saved: dict[str, Path]) -> None:
    before = saved["log_odds"].read_bytes()
    with pytest.raises(ConfigError, match="the map itself would be overwritten"):
        run_export(saved["log_odds"], "--to", saved["log_odds"])
    assert saved["log_odds"].read_bytes() == before


@pytest.mark.parametrize("extension", [e for e in FORMATS if e != ".yaml"])
def test_a_file_that_cannot_be_written(extension: str, tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="cannot be written"):
        export_map(room_map("mrf"), tmp_path / "absent" / f"map{extension}", ExportOptions(**BAND))


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"threshold": 1.0}, "threshold must lie between 0 and 1"),
        ({"cubes": True, "mesh": True}, "choose one"),
        ({"z_min": 2.0, "z_max": 1.0}, "z_min must lie below z_max"),
        ({"z_min": float("nan")}, "z_min must be a number"),
        ({"occupied_from": 0.3}, "free_below must not be larger"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        ExportOptions(**options)


def test_an_empty_map(tmp_path: Path) -> None:
    m = LogOddsMap(0.1)
    for name in ("map.ply", "map.bt", "map.ot", "map.npz", "map.html"):
        assert export_map(m, tmp_path / name)[0].stat().st_size > 0
    for name in ("map.glb", "map.pgm"):
        with pytest.raises(ConfigError, match="the map is empty"):
            export_map(m, tmp_path / name)
