"""A layer that pixels feed is an entry of the table and a visitor: a histogram of eight classes that the
package does not know (support/label_layer.py) is counted by the posterior, and is exact under edits, in
files, in windows, in chunks and for other times."""

import runpy
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import colored_scene as scene
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from inputs_frames import Frames
from label_layer import CLASSES, ENTRY, LABELS, PAGE
from one_pixel import VOXEL, FineMap, cavities, look_along, spread
from oracles import inference as reference
from oracles.forward import Noise
from sliding_camera import CAMERA, WALL_M
from window_walk import OUT, probes, unwindowed, windowed

from taichi_mrf.config.sections import InferenceConfig, TimeConfig
from taichi_mrf.datasets.derived import resampled
from taichi_mrf.errors import ConfigError, KeyframeError, MapFileError
from taichi_mrf.export.chunk_blocks import write_chunks
from taichi_mrf.export.formats import export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.geometry.up import Z_UP
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.merging import frame_of
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.colored import shown_colors
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.shown_extras import BaselineOverlay, ShownColors
from taichi_mrf.viewer.messages import pack_log_odds
from taichi_mrf.viewer.scene import coloring
from taichi_mrf.viewer.scene.coloring import COLORINGS, legend_html
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import look_of
from taichi_mrf.viewer.scene.voxel_store import VoxelStore, facing
from taichi_mrf.voxels.layers import COLORS, LAYERS

pytestmark = pytest.mark.usefixtures("backend", "label_entry")


@pytest.fixture(scope="module")
def label_entry() -> Iterator[None]:
    """The table with the entry."""
    LAYERS[LABELS] = ENTRY
    yield
    del LAYERS[LABELS]


def add(m: MRFMap, number: int, **parameters: Any) -> int:
    """A view of the scene in colour: class 3 is the thing, 7 the wall."""
    depth, color = scene.view(*scene.PLACES[number], seed=number)
    labels = np.where((color == scene.RED).all(axis=-1), 3, 7).astype(np.uint8)
    place, images = scene.pose(*scene.PLACES[number]), {LABELS: labels}
    return m.add_keyframe(depth, place, scene.CAMERA, color=color, images=images, **parameters)


def build(numbers: list[int], **parameters: Any) -> MRFMap:
    m = MRFMap(scene.VOXEL, scene.NOISE, **parameters)
    for number in numbers:
        add(m, number)
    m.infer()
    return m


def labels(m: Any) -> np.ndarray:
    return np.asarray(m.pixel_layers[LABELS].at(scene.probes()))


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_histogram_is_that_of_the_posterior(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(2, 2, 8.0, 8.0, 0.5, 0.5)
    config = InferenceConfig(outlier_floor=1e-3, ray_density=0.0)
    m = FineMap(VOXEL, PolynomialNoise((0.08,)), inference=config, max_depth=1.5)
    middle, rays, given_labels = rng.uniform(-1, 1, 3), {}, {}
    for _ in range(2):
        direction = rng.normal(size=3)
        T = look_along(middle - 0.6 * direction / np.linalg.norm(direction), direction, rng)
        depth = rng.uniform(0.55, 0.65, camera.shape).astype(np.float32)
        image = rng.integers(0, CLASSES + 1, camera.shape).astype(np.uint8)
        id = m.add_keyframe(depth, T, camera, images={LABELS: image})
        rays[id] = reference.cast(depth, T, camera, VOXEL, Noise((0.08,)), max_depth=1.5)
        given_labels[id] = image.reshape(-1)
    m.infer()
    expected: dict[reference.Voxel, np.ndarray] = {}
    for id, k in m.keyframes.items():
        cavity = cavities(m, k)
        mine: dict[reference.Voxel, np.ndarray] = {}
        for ray, label in zip(rays[id], given_labels[id].tolist(), strict=True):
            if label > 0:
                for voxel, w in spread(ray, cavity, config, m.prior).items():
                    mine.setdefault(voxel, np.zeros(CLASSES))[label - 1] += w
        for voxel, share in mine.items():
            expected[voxel] = expected.get(voxel, np.zeros(CLASSES)) + np.rint(
                8 * share
            )  # STEPS, written out
    got = m.pixel_layers[LABELS].at((np.array(list(expected)) + 0.5) * VOXEL).astype(float)
    wanted = np.array(list(expected.values()))
    np.testing.assert_allclose(got, wanted, atol=2)
    assert (got == wanted).mean() > 0.95
    assert not m.has_colors


@settings(max_examples=6)
@given(history=scene.HISTORIES, final=scene.FINAL)
def test_edits_are_exact(history: list[tuple[str, int]], final: list[int]) -> None:
    m = scene.edited(history, final, look=labels, add=add)
    np.testing.assert_array_equal(labels(m), labels(build(sorted(final))))


def test_thing_and_wall_have_their_classes_and_colours_are_as_without_labels() -> None:
    m = build([0, 1, 2, 3])
    seen = labels(m)
    z = scene.probes()[:, 2]
    for class_, depth_m in ((3, scene.THING_Z), (7, scene.WALL_Z)):
        near = np.abs(z - depth_m) < 2 * scene.VOXEL
        assert (seen[near][:, class_ - 1] > 0).sum() > 50
    assert not np.delete(seen, [2, 6], axis=1).any()
    np.testing.assert_array_equal(m.colors(scene.probes()), scene.build([0, 1, 2, 3]).colors(scene.probes()))


def test_freezing_and_files_keep_it(tmp_path: Path) -> None:
    m = build([0, 1, 2])
    before = labels(m)
    assert before.any()
    m.save(tmp_path / "live.npz")
    for id in [0, 2]:
        m.freeze_keyframe(id)
        np.testing.assert_array_equal(labels(m), before)
    m.infer()
    expected = labels(m)
    m.save(tmp_path / "frozen.npz")
    loaded, live = MRFMap.load(tmp_path / "frozen.npz"), MRFMap.load(tmp_path / "live.npz")
    np.testing.assert_array_equal(labels(loaded), expected)
    np.testing.assert_array_equal(labels(live), before)
    np.testing.assert_array_equal(live.keyframes[1].beside(LABELS), m.keyframes[1].beside(LABELS))
    for each, wanted in ((loaded, expected), (live, before)):
        each.infer()
        np.testing.assert_array_equal(labels(each), wanted)


def test_a_damaged_share_is_named(tmp_path: Path) -> None:
    m = build([0, 1])
    m.freeze_keyframe(0)
    m.pixel_layers[LABELS].frozen.sums[0] = -1
    m.save(tmp_path / "map.npz")
    with pytest.raises(MapFileError, match="frozen_labels_bricks or its sums"):
        MRFMap.load(tmp_path / "map.npz")


def test_another_time_has_its_own() -> None:
    m = MRFMap(scene.VOXEL, scene.NOISE, time=TimeConfig(half_life_s=100.0))
    add(m, 0, stamp_s=0.0)
    add(m, 3, stamp_s=5.0)
    m.infer()
    then, now = labels(m.at(2.0)), labels(m)
    assert then.any()
    assert now.sum() > then.sum()


def test_windows_and_chunks_hold_it(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="a window needs the extra store")
    m, other = windowed(tmp_path / "far.zarr"), unwindowed()
    for number, place_m in enumerate(OUT):
        here, there = (_walked(each, place_m, number) for each in (m, other))
        for id in m.frozen.keys() & other.keyframes.keys():
            other.freeze_keyframe(id)
        m.renew([here])
        other.renew([there])
    assert m.window is not None
    assert len(m.window.parked) > 1
    for each in (m, other):
        each.infer()
    m.save(tmp_path / "map.npz")
    points = probes(other)
    expected = other.pixel_layers[LABELS].at(points)
    assert expected.any()
    whole = ChunkedMap.open(tmp_path / "map_window.zarr")
    write_chunks(tmp_path / "other.zarr", other, fed=other.pixel_layers)
    for found in (whole, take_part(whole), ChunkedMap.open(tmp_path / "other.zarr")):
        np.testing.assert_array_equal(found.pixel_layers[LABELS].at(points), expected)
    part = take_part(whole)
    slots = part.view.pool.in_use
    np.testing.assert_array_equal(
        part.pixel_layers[LABELS].within(slots),
        other.pixel_layers[LABELS].within(other._registry.topology.slots(part.view.pool.bricks[slots])),
    )
    again = MRFMap.load(tmp_path / "map.npz")
    assert again.window is not None
    for back_m in reversed(OUT):  # what was parked comes back
        again.window.follow(again, np.array([back_m, 0.0, 0.0]))
    near = np.abs(points[:, 0]) < 0.3
    got = again.pixel_layers[LABELS].at(points[near])
    assert got.any()


def _walked(m: MRFMap, place_m: float, number: int) -> int:
    T = np.eye(4)
    T[:3, 3] = place_m, 0.013, 0.021
    rng = np.random.default_rng(number)
    depth = (WALL_M + rng.normal(0.0, 0.004, CAMERA.shape)).astype(np.float32)
    image = rng.integers(1, CLASSES + 1, CAMERA.shape).astype(np.uint8)
    return m.add_keyframe(depth, T, CAMERA, images={LABELS: image})


def test_wrong_images_are_refused() -> None:
    m = MRFMap(scene.VOXEL, scene.NOISE)
    depth, _ = scene.view(0.0)
    good = np.ones(scene.CAMERA.shape, np.uint8)
    for name, wrong, said in (
        (LABELS, good[1:], "the image kinds must be uint8 of the shape"),
        (LABELS, good.astype(float), "the image kinds must be uint8"),
        ("heat", good, "no layer follows from an image 'heat': there are color, kinds"),
    ):
        with pytest.raises(KeyframeError, match=said):
            m.add_keyframe(depth, scene.pose(0.0), scene.CAMERA, images={name: wrong})
    with pytest.raises(ConfigError, match="pass no color or images"):
        LogOddsMap(scene.VOXEL).add_keyframe(depth, scene.pose(0.0), scene.CAMERA, images={LABELS: good})


def test_frames_bring_it_also_thinned_out() -> None:
    depth, _ = scene.view(0.0)
    image = np.random.default_rng(5).integers(0, CLASSES + 1, scene.CAMERA.shape).astype(np.uint8)
    frame = Frame(depth, scene.pose(0.0), scene.CAMERA, 3.0, "first", images={LABELS: image})
    m = MRFMap(scene.VOXEL, scene.NOISE)
    id = m.add(frame)
    np.testing.assert_array_equal(m.keyframes[id].beside(LABELS), image)
    assert frame_of(m.keyframes[id]).images.keys() == {LABELS}
    LogOddsMap(scene.VOXEL).add(frame)  # has no such layers, as it has no colours
    thin = resampled(Frames("one", scene.CAMERA, frames=[frame]), (), 3).read(0)
    np.testing.assert_array_equal(thin.images[LABELS], image[1::3, 1::3])
    turned = resampled(Frames("one", scene.CAMERA, frames=[frame]), (), 1, "upside-down").read(0)
    np.testing.assert_array_equal(turned.images[LABELS], image[::-1, ::-1])


def test_exports_have_it_under_its_name(tmp_path: Path) -> None:
    m = build([0, 1, 2])
    for name in ("map.ply", "map.npz", "map.zarr", "cells.ply"):
        export_map(m, tmp_path / name, ExportOptions(cells=name.startswith("cells")))
    centres, _ = m.voxels()
    wanted = m.pixel_layers[LABELS].at(centres)
    assert (wanted[:, [2, 6]].sum(axis=0) > 0).all()
    for name in ("map.ply", "cells.ply"):
        np.testing.assert_array_equal(_points(tmp_path / name)[: len(wanted), 3:], wanted)
    assert f"comment {LABELS} is {ENTRY.about}\n".encode() in (tmp_path / "map.ply").read_bytes()
    with np.load(tmp_path / "map.npz") as arrays:
        middle = (arrays["voxels"] + 0.5) * arrays["voxel_size"]
        np.testing.assert_array_equal(arrays[LABELS], m.pixel_layers[LABELS].at(middle))
        assert arrays[LABELS].shape == (len(middle), CLASSES)
        assert arrays[LABELS].any()
    stored = ChunkedMap.open(tmp_path / "map.zarr")
    np.testing.assert_array_equal(stored.pixel_layers[LABELS].at(centres), wanted)
    np.testing.assert_array_equal(stored.colors(centres), m.colors(centres))
    export_map(take_part(stored), tmp_path / "part.ply")
    in_order = (np.unique(_points(tmp_path / name), axis=0) for name in ("part.ply", "map.ply"))
    np.testing.assert_array_equal(*in_order)


def _points(path: Path) -> np.ndarray:
    """Position and labels of each point of a file, (n, 3 + 8), as another library reads it."""
    with open(path, "rb") as file:
        told = trimesh.exchange.ply.load_ply(file)["metadata"]["_ply_raw"]["vertex"]["data"]
    names = [*"xyz", *(f"{LABELS}_{class_}" for class_ in range(CLASSES))]
    return np.stack([np.asarray(told[each], np.float64).ravel() for each in names], axis=1)


def test_exports_without_values_do_not_name_it(tmp_path: Path) -> None:
    m = scene.build([0, 1])
    for name in ("map.ply", "map.npz"):
        export_map(m, tmp_path / f"with_{name}")
        del LAYERS[LABELS]
        export_map(m, tmp_path / f"without_{name}")
        LAYERS[LABELS] = ENTRY
        assert (tmp_path / f"with_{name}").read_bytes() == (tmp_path / f"without_{name}").read_bytes()


def test_the_page_colours_voxels_by_it_with_a_legend(monkeypatch: pytest.MonkeyPatch) -> None:
    by_the_table = runpy.run_path(coloring.__file__)["COLORINGS"]
    assert by_the_table.keys() - COLORINGS.keys() == {PAGE.coloring}
    monkeypatch.setitem(COLORINGS, PAGE.coloring, by_the_table[PAGE.coloring])
    m, store = build([0, 1, 2]), VoxelStore()
    slots = m.view.pool.in_use
    store.put(m.view.pool.bricks[slots], log_odds=pack_log_odds(m.view.pool.read("belief", slots)))
    find = ShownColors(cast(Mapper, SimpleNamespace(map=m)))
    sent = find.changes()
    assert {update.layer for update in sent} == {COLORS, LABELS}
    assert not find.changes()
    for update in sent:
        store.put(update.bricks, **{update.layer: update.colors})
    seen = {}
    for name in ("photo", PAGE.coloring):
        look = look_of(ViewOptions(color_by=name, shade=False), store, Z_UP, scene.VOXEL)
        for key in store.chunks:
            shown = store.shown(key, 0.0, None)
            centres_m = (shown.cells + np.array(key) * 64 + 0.5) * scene.VOXEL
            colors = look.paint(shown, centres_m, facing(shown.cells))
            seen |= {(name, *at): rgb for at, rgb in zip(centres_m.tolist(), colors.tolist(), strict=True)}
        legend = legend_html(look.scale)
        assert ("class 7" in legend and PAGE.caption in legend) == (name == PAGE.coloring)
    points = np.array([at[1:] for at in seen if at[0] == PAGE.coloring])
    counts, photo = m.pixel_layers[LABELS].at(points), shown_colors(m, points)
    told = counts.any(axis=1)
    assert told.sum() > 100
    for point, count, rgb in zip(points, counts, photo, strict=True):
        class_color = [30 * (count.argmax() + 1), 255 - 30 * (count.argmax() + 1), 40]
        assert seen[(PAGE.coloring, *point)] == (class_color if count.any() else [128] * 3)
        assert seen[("photo", *point)] == rgb.tolist()


def test_a_live_run_edits_keyframes_with_it_and_its_baseline_does_without() -> None:
    m, depth = MRFMap(scene.VOXEL, scene.NOISE), scene.view(0.0)[0]
    image = np.full(scene.CAMERA.shape, 3, np.uint8)
    frame = Frame(depth, scene.pose(0.0), scene.CAMERA, 3.0, "first", images={LABELS: image})
    mapper, id = Mapper(m), m.add(frame)
    entry = mapper.enter(Added(frame, id, m.keyframes[id].rays))
    baseline = BaselineOverlay(m.config, m.noise)
    assert baseline.catch_up(mapper, lambda progress: True)
    assert len(baseline.map.keyframes) == 1
    mapper.switch(entry.id, on=False)
    mapper.switch(entry.id, on=True)
    (again,) = m.keyframes.values()
    np.testing.assert_array_equal(again.beside(LABELS), image)
