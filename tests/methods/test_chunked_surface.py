"""Colours and the measured surface of maps in chunks: those of the map that they were made from, in one piece
or part by part."""

from pathlib import Path

import colored_scene as scene
import numpy as np
import pytest
import trimesh
from console import carry_out
from queried_maps import room_map

from taichi_mrf.cli.info import map_facts
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.cast import cast_rays
from taichi_mrf.system import runtime

pytest.importorskip("zarr", reason="maps in chunks need the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")

RAYS = ExportOptions(surface="rays", mesh=True)


@pytest.fixture(scope="module")
def m(one_backend: str) -> MRFMap:
    """The scene, which lies around the corner of several chunks: they end at 0 and at 3.2 m."""
    return scene.build([0, 1, 2, 3])


@pytest.fixture(scope="module")
def store(m: MRFMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "map.zarr"
    export_map(m, path, RAYS)
    return path


def test_surface_and_colours_come_back_exactly(m: MRFMap, store: Path, tmp_path: Path) -> None:
    part = take_part(ChunkedMap.open(store, cache_mb=2))
    ours, theirs = part.surface(), m.surface()
    assert len(theirs.triangles) > 500
    for name in ("vertices_m", "triangles", "normals", "std_m", "colors"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    np.testing.assert_array_equal(part.colors(scene.probes()), m.colors(scene.probes()))
    export_map(part, tmp_path / "again.zarr", RAYS)
    again = take_part(ChunkedMap.open(tmp_path / "again.zarr")).surface()
    np.testing.assert_array_equal(again.vertices_m, theirs.vertices_m)
    for name in ("mesh.glb", "mesh.ply", "map.ot"):
        export_map(part, tmp_path / name, ExportOptions(mesh=name == "mesh.ply"))
        export_map(m, tmp_path / f"of_{name}", ExportOptions(mesh=name == "mesh.ply"))
        assert (tmp_path / name).read_bytes() == (tmp_path / f"of_{name}").read_bytes()


def test_surfaces_of_parts_meet_without_seams(m: MRFMap, store: Path) -> None:
    chunked = ChunkedMap.open(store)
    low, high = chunked.extent
    cut = 0.4  # metres, a border of bricks; the chunks' own border is at 0
    halves = [
        take_part(chunked, low, (cut - 0.01, *high[1:])),
        take_part(chunked, (cut + 0.01, *low[1:]), high),
    ]
    whole = m.surface()
    surfaces = [half.surface() for half in halves]
    assert sum(len(each.triangles) for each in surfaces) == len(whole.triangles)
    count = len(surfaces[0].vertices_m)
    vertices = np.concatenate([each.vertices_m for each in surfaces])
    common = {tuple(v) for v in surfaces[0].vertices_m} & {tuple(v) for v in surfaces[1].vertices_m}
    assert len(common) > 20
    assert len({tuple(v) for v in vertices}) == len(whole.vertices_m)
    joined = trimesh.Trimesh(vertices, np.concatenate([surfaces[0].triangles, surfaces[1].triangles + count]))
    joined.merge_vertices(digits_vertex=12)
    single = trimesh.Trimesh(whole.vertices_m, whole.triangles, process=False)
    assert len(joined.vertices) == len(single.vertices)
    uses = [sorted(np.bincount(mesh.edges_unique_inverse)) for mesh in (joined, single)]
    assert uses[0] == uses[1]
    normals = {tuple(v): n for v, n in zip(whole.vertices_m, whole.normals, strict=True)}
    for each in surfaces:
        for vertex, normal in zip(each.vertices_m, each.normals, strict=True):
            np.testing.assert_allclose(normal, normals[tuple(vertex)], atol=1e-5)


def test_info_tells_what_a_store_holds(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = map_facts(str(store))
    assert (facts["colors"], facts["surface"]) == (True, True)
    assert carry_out("info", store) == 0
    assert "colors and surface" in capsys.readouterr().out


def test_states_probabilities_and_balls_are_those_of_the_map(m: MRFMap, store: Path, tmp_path: Path) -> None:
    chunked, points = ChunkedMap.open(store), scene.probes()
    marginal, ours, theirs = (
        chunked.marginals.occupancy(points),
        chunked.occupancy(points),
        m.decided,
    )
    assert ((ours > 0.5) & (marginal <= 0.5)).sum() > 20
    np.testing.assert_allclose(ours, theirs.occupancy(points), atol=1e-6)
    np.testing.assert_allclose(marginal, m.marginals.occupancy(points), atol=1e-6)
    calibrated = chunked.calibrated().occupancy(points)
    np.testing.assert_allclose(calibrated, m.calibrated().occupancy(points), atol=1e-5)
    assert np.abs(calibrated - marginal).max() > 0.1
    part = take_part(chunked).decided
    np.testing.assert_array_equal(chunked.state(points), theirs.state(points))
    assert {tuple(c) for c in part.voxels()[0].round(6)} == {tuple(c) for c in theirs.voxels()[0].round(6)}
    rays = scene.CAMERA.rays()[::6, ::6].reshape(-1, 3)
    hits = [cast_rays(each, np.zeros(3), rays, 4.0).range for each in (part, theirs)]
    np.testing.assert_allclose(hits[0], hits[1], atol=1e-5)
    whole, some = take_part(chunked), points[::997]
    np.testing.assert_allclose(whole.occupied_within(some, 0.12), m.occupied_within(some, 0.12), atol=1e-5)
    way = np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 1.0], [0.4, 0.0, 1.9]])
    assert whole.path_collision(way, 0.1) == pytest.approx(m.path_collision(way, 0.1), abs=1e-5)
    out = tmp_path / "voxels.ply"
    assert carry_out("export", store, "--to", out, "--arch", runtime.active() or "cpu") == 0
    assert len(trimesh.load(out).vertices) >= len(theirs.voxels()[0])


def test_a_map_without_them_says_what_to_do(m: MRFMap, tmp_path: Path) -> None:
    export_map(m, tmp_path / "bare.zarr", ExportOptions(color_by="marginal"))
    part = take_part(ChunkedMap.open(tmp_path / "bare.zarr"))
    assert not part.has_colors
    assert not part.colors(scene.probes()).any()
    for problem in (part.surface, lambda: export_map(part, tmp_path / "mesh.ply", RAYS)):
        with pytest.raises(ConfigError, match=r"map the recording again with --keep-surface, or export from"):
            problem()
    with pytest.raises(ConfigError, match="no measurements of rays: map the recording again with"):
        part.source.calibrated()
    with pytest.raises(ConfigError, match="map the recording with --color"):
        export_map(part, tmp_path / "mesh.ply", ExportOptions(color_by="photo"))
    export_map(part, tmp_path / "mesh.ply", ExportOptions(mesh=True))
    note = export_note(part, tmp_path / "mesh.ply", ExportOptions(mesh=True))
    assert "where the marginal is 0.5; the images" in str(note)
    assert "--keep-surface" not in str(export_note(room_map("log_odds"), Path("mesh.glb")))


def test_damaged_extras_are_named(store: Path, tmp_path: Path) -> None:
    import shutil

    path = Path(shutil.copytree(store, tmp_path / "map.zarr"))
    for name, read in (("colors", lambda p: p.colors(scene.probes())), ("surface", lambda p: p.surface())):
        victim = max((path / name / "c").rglob("0"), key=lambda file: file.stat().st_size * file.is_file())
        victim.write_bytes(victim.read_bytes()[:40])
        with pytest.raises(MapFileError, match=name):
            read(take_part(ChunkedMap.open(path)))
    document = path / "surface" / "zarr.json"
    document.write_text(document.read_text().replace("float32", "float64"))
    with pytest.raises(MapFileError, match="surface is not stored as float32"):
        ChunkedMap.open(path)
