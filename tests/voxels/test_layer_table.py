"""The table of layers: two layers do not share an image, a name in files or a colouring."""

import runpy
from dataclasses import replace

import pytest
from label_layer import ENTRY, LABELS

from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.scene import coloring
from taichi_mrf.voxels.layers import COLORS, LAYERS, pixel_layers

MADE, OF_COLORS = ENTRY.from_pixels, LAYERS[COLORS].from_pixels
assert MADE is not None
assert OF_COLORS is not None

SHARED = {
    "image 'color'": replace(MADE, image=OF_COLORS.image),
    "stored 'frozen_color'": replace(MADE, stored=OF_COLORS.stored),
    "page.coloring 'photo'": replace(MADE, page=OF_COLORS.page),
}


@pytest.mark.parametrize("what", SHARED)
def test_what_two_layers_share_is_named_with_both(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAYERS, LABELS, ENTRY)
    assert pixel_layers().keys() == {COLORS, LABELS}
    monkeypatch.setitem(LAYERS, LABELS, replace(ENTRY, from_pixels=SHARED[what]))
    with pytest.raises(ConfigError, match=f"layers colors and kinds: both have {what}; each needs"):
        pixel_layers()


@pytest.mark.parametrize("name", ["height", "plain grey"])
def test_a_layer_does_not_replace_a_colouring_of_the_page(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    page = replace(MADE.page, coloring=name)
    monkeypatch.setitem(LAYERS, LABELS, replace(ENTRY, from_pixels=replace(MADE, page=page)))
    with pytest.raises(ConfigError, match=f"layer kinds: has page.coloring '{name}', which is the page's"):
        runpy.run_path(coloring.__file__)
