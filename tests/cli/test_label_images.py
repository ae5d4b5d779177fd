"""Images beside depth in a folder's recording fill the layer that their folder is named after, by `map`."""

import json
import re
from pathlib import Path

import colored_scene as scene
import numpy as np
import pytest
from console import FAST, taichi_mrf
from datasets_recordings import FORMATS, Content, write_image
from label_layer import CLASSES, ENTRY, LABELS
from label_recording import THING, WALL, write_scene
from refusals import bad_frame

from taichi_mrf.datasets import open_dataset
from taichi_mrf.export.formats import export_map
from taichi_mrf.methods.registry import load_map
from taichi_mrf.voxels.layers import COLORS, LAYERS


@pytest.fixture(autouse=True)
def label_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAYERS, LABELS, ENTRY)


def test_map_fills_the_layer(tmp_path: Path) -> None:
    written = write_scene(tmp_path / "walk")
    out = tmp_path / "run"
    assert not taichi_mrf("map", tmp_path / "walk", "--depth-scale", "1000", "--out", out, *FAST).returncode
    m = load_map(out / "map.npz")
    assert len(m.keyframes) > 1
    for keyframe in m.keyframes.values():
        np.testing.assert_array_equal(keyframe.beside(LABELS), written[int(keyframe.name)])
    centres, _ = m.decided.voxels(0.5)
    values = m.pixel_layers[LABELS].at(centres)
    seen = values.any(axis=-1)
    assert seen.mean() > 0.9
    is_thing = centres[seen, 2] < (scene.THING_Z + scene.WALL_Z) / 2
    assert 0 < is_thing.sum() < seen.sum()
    right = values[seen].argmax(axis=-1) + 1 == np.where(is_thing, THING, WALL)
    assert right.mean() > 0.95


def test_info_names_the_layers_of_saved_maps(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="maps in chunks need the extra store")
    m = scene.build([0])
    view, place = scene.view(0.0, seed=1)[0], scene.pose(0.0)
    names = {"colors": [COLORS], "both": [COLORS, LABELS], "labels": [LABELS]}
    for kind, held in names.items():
        if kind == "both":
            m.add_keyframe(
                view, place, scene.CAMERA, images={LABELS: np.full(scene.CAMERA.shape, THING, np.uint8)}
            )
        elif kind == "labels":
            m.remove_keyframe(next(iter(m.keyframes)))
        m.infer()
        m.save(tmp_path / f"{kind}.npz")
        export_map(m, tmp_path / f"{kind}.zarr")
        for suffix in ("npz", "zarr"):
            path = tmp_path / f"{kind}.{suffix}"
            facts = json.loads(taichi_mrf("info", path, "--json").stdout)
            assert facts["pixel_layers"] == held
            assert facts.get("colors", COLORS in held) == (COLORS in held)
            said = taichi_mrf("info", path).stdout
            assert re.search(rf"also holds +\S {' and '.join(held)} ", said), said
    m.freeze_keyframe(next(iter(m.keyframes)))  # which leaves sums, and no image
    m.save(tmp_path / "frozen.npz")
    assert json.loads(taichi_mrf("info", tmp_path / "frozen.npz", "--json").stdout)["pixel_layers"] == [
        LABELS
    ]


@pytest.mark.parametrize("name", FORMATS)
def test_every_folder_of_images_may_have_them(tmp_path: Path, name: str) -> None:
    content = Content()
    folder = FORMATS[name].write(tmp_path / "walk", content)
    assert all(not frame.images for frame in open_dataset(folder, color=False))
    rng = np.random.default_rng(3)
    written = [rng.integers(0, CLASSES + 1, content.size).astype(np.uint8) for _ in content.depth]
    for frame, labels in zip(open_dataset(folder).frame_names, written, strict=True):
        write_image(folder / LABELS / f"{frame}.png", labels)
    dataset = open_dataset(folder, color=False)
    assert "kinds: from the images in kinds/" in dataset.notes
    for frame, labels in zip(dataset, written, strict=True):
        np.testing.assert_array_equal(frame.images[LABELS], labels)


BAD = {
    "missing": (None, "the image is missing"),
    "16 bits": (
        np.zeros((36, 48), np.uint16),
        "found 16-bit with 1 channel",
    ),
    "a palette": (np.zeros((36, 48, 3), np.uint8), "found 8-bit with 3 channels"),
    "another size": (np.zeros((18, 24), np.uint8), "the image has 24 x 18 pixels, the camera 48 x 36"),
}


@pytest.mark.parametrize("kind", BAD)
def test_an_image_that_does_not_fit_is_told_with_file_and_frame(tmp_path: Path, kind: str) -> None:
    image, said = BAD[kind]
    write_scene(tmp_path)
    path = tmp_path / LABELS / "00002.png"
    path.unlink()
    if image is not None:
        write_image(path, image)
    dataset = open_dataset(tmp_path, depth_scale=1000.0)
    dataset.read(1)
    bad_frame(dataset, 2, f"frame 00002: {path}: ", said)
    done = taichi_mrf("map", tmp_path, "--depth-scale", "1000", "--out", tmp_path / "run", *FAST)
    assert done.returncode == 2
    assert f"frame 00002: {path}: " in done.stderr
    options = ("--depth-scale", "1000", "--limit", "3", "--skip-bad-frames", "--out", tmp_path / "rest")
    assert taichi_mrf("map", tmp_path, *options, *FAST).returncode == 0
    assert "00002" not in {each.name for each in load_map(tmp_path / "rest" / "map.npz").keyframes.values()}
