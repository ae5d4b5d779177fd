"""The measured surface on the page: meshes in the colours of the scale, in the place of voxels."""

import json
import re
import runpy
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from handled_page import HandledPage

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.live.panel import Clicked
from taichi_mrf.viewer.scene import coloring
from taichi_mrf.viewer.scene.base_panel import OptionsMoved
from taichi_mrf.viewer.scene.coloring import COLORINGS, Coloring, Measure, legend_html
from taichi_mrf.viewer.scene.surface_layer import before_tone_mapping, unlit_glb
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.voxels.layers import COLORS, LAYERS, FromPixels, Layer, OnPage

VOXEL = 0.1
HELLO = m.Hello(
    "a recording",
    "cpu",
    "a device",
    "mrf",
    VOXEL,
    -2.2,
    0.1,
    "voxel_size: 0.1",
    has_surface=True,
)
DONE = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)
VIEW = m.SurfaceView(
    eye_m=np.array([3.0, -9.0, 5.0]),
    target_m=np.array([3.0, -3.0, 1.5]),
    up=np.array([0.0, 0.0, 1.0]),
    light=np.array([0.6, -0.8, 0.0]),
    fov_rad=0.6,
    photo=False,
)
CHUNK = (0, -1, 0)
BRICK = m.Bricks(
    "map",
    np.zeros((1, 3), np.int32),
    np.full((1, 512), 900, np.int16),
    np.ones((1, 512), np.uint8),
    np.zeros((0, 3), np.int32),
)
GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def patch(colors: np.ndarray | None = None, empty: bool = False) -> m.SurfacePatch:
    """Two triangles across x at y = -3 m, which face -y."""
    vertices = np.array([[1, -3, 1], [3, -3, 1], [3, -3, 2], [5, -3, 1]], np.float32)
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    return m.SurfacePatch(
        CHUNK,
        vertices,
        triangles[:0] if empty else triangles,
        np.tile(np.array([0, -127, 0], np.int8), (4, 1)),
        np.array([0.001, 0.002, 0.003, 0.010], np.float32),
        colors,
    )


class SurfacePage(HandledPage):
    """The live page of a map of one brick."""

    def __init__(self) -> None:
        super().__init__(Page, HELLO)
        self.take(BRICK)

    def draw(self, **options: object) -> str:
        """Draw with these options; the line of counts."""
        before, self.page.options = self.page.options, replace(ViewOptions(), **options)  # type: ignore[arg-type]
        self.page.options_changed(before)
        assert self.page.map is not None
        self.page.map.look_changed()
        self.page._flush()
        shown, _, _ = self.page.panel._shown.content.partition(" · ground")
        return shown

    def is_visible(self, name: str) -> bool:
        return self.server.scene._handle_from_node_name[name].visible

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices in metres, triangles and colours of the only chunk, as a browser reads them."""
        node = self.server.scene._handle_from_node_name["/surface/0_-1_0"]
        vertices, triangles, light = parts_of(node.glb_data)  # type: ignore[attr-defined]
        return vertices + np.array(node.position), triangles, tone_mapped(light)


def parts_of(glb: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    length, kind = struct.unpack("<I4s", glb[12:20])
    scene, data = json.loads(glb[20 : 20 + length]), glb[28 + length :]
    assert (glb[:4], kind, len(glb)) == (b"glTF", b"JSON", struct.unpack("<I", glb[8:12])[0])
    types = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}
    found = []
    for accessor, view in zip(scene["accessors"], scene["bufferViews"], strict=True):
        part = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        found.append(np.frombuffer(part, types[accessor["componentType"]]).reshape(-1, 3))
    return found[0], found[2], found[1]


def tone_mapped(light: np.ndarray) -> np.ndarray:
    """Colours that three.js makes of linear light with ACESFilmicToneMapping, as sRGB (n, 3) uint8."""
    into = [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
    back = [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
    v = (light.astype(np.float64) / 0.6) @ np.array(into).T
    film = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    share = np.clip(film @ np.array(back).T, 0.0, 1.0)
    srgb = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.rint(255 * srgb).astype(np.uint8)


@pytest.fixture(scope="module")
def drawn() -> Iterator[SurfacePage]:
    running = SurfacePage()
    yield running
    running.server.stop()


def test_colours_survive_the_tone_mapping() -> None:
    colors = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    colors[:3] = [[0, 0, 0], [255, 255, 255], [0, 255, 0]]
    shown = tone_mapped(before_tone_mapping(colors))
    assert np.abs(shown.astype(int) - colors).max() <= 1


def test_a_large_mesh_has_large_indices() -> None:
    vertices = np.random.default_rng(1).random((70000, 3)).astype(np.float32)
    triangles = np.array([[0, 1, 69999]])
    found = parts_of(unlit_glb(vertices, triangles, np.zeros((70000, 3), np.uint8)))
    np.testing.assert_array_equal(found[0], vertices)
    np.testing.assert_array_equal(found[1], triangles)


def test_the_surface_takes_the_place_of_voxels_once_it_is_there(drawn: SurfacePage) -> None:
    assert drawn.asked == [m.Watch(False, None, False, surface=True)]  # the page opens with it
    drawn.take(patch())
    assert drawn.draw() == "512 voxels shown"  # some of it may still be on its way
    scene = drawn.page.map
    assert scene is not None
    assert scene.scale is not None
    assert "chance" in scene.scale.measure.label  # voxels show how sure the map is while it grows
    drawn.take(VIEW)
    assert drawn.draw() == "2 triangles shown"
    assert (drawn.is_visible("/voxels"), drawn.is_visible("/surface")) == (False, True)
    vertices, triangles, _ = drawn.mesh()
    np.testing.assert_allclose(vertices[triangles], patch().vertices_m[patch().triangles], atol=1e-6)
    on_surface = scene.scale
    assert "height" in on_surface.measure.label
    assert drawn.draw(draw_as="voxels") == "512 voxels shown"
    assert scene.scale == on_surface  # one range of heights for both
    assert (drawn.is_visible("/voxels"), drawn.is_visible("/surface")) == (True, False)
    drawn.take(patch(empty=True))
    assert drawn.draw() == "512 voxels shown"


def status(**changes: object) -> m.Status:
    done = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)
    return replace(done, **changes)  # type: ignore[arg-type]


def test_while_frames_are_read_voxels_are_shown(drawn: SurfacePage) -> None:
    drawn.take(patch())
    drawn.take(VIEW)
    widgets = [drawn.page.panel.view_options.handles[name] for name in ("draw_as", "color_by")]
    for changes, shown, said in (
        ({"finished": False}, "512 voxels", ["voxels", "marginal probability"]),
        ({"paused": True, "finished": False}, "2 tri", ["surface", "height"]),
    ):
        drawn.take(status(**changes))
        assert drawn.draw().startswith(shown)
        assert [widget.value for widget in widgets] == said
        assert ("at the end, or while paused" in widgets[0].hint) == (said[0] == "voxels")


def test_a_browser_begins_with_the_view_of_the_picture(drawn: SurfacePage) -> None:
    viewpoint, start = drawn.page.viewpoint, drawn.server.initial_camera
    drawn.page._take_status(status(finished=False))
    viewpoint.map_grew(np.zeros(3), np.ones(3))
    drawn.page._take_status(status())
    drawn.take(VIEW)
    along = start.look_at - start.position
    np.testing.assert_allclose(np.cross(along, VIEW.target_m - VIEW.eye_m), 0, atol=1e-9)
    np.testing.assert_array_equal(start.up, VIEW.up)
    assert start.fov == VIEW.fov_rad
    before = start.position
    viewpoint.map_grew(np.zeros(3), np.full(3, 9.0))
    drawn.take(replace(VIEW, eye_m=np.zeros(3)))  # after an edit, say
    np.testing.assert_array_equal(start.position, before)


def test_the_page_opens_in_the_colours_of_photographs_where_the_picture_does() -> None:
    running = SurfacePage()
    try:
        for chosen, expected in (("height", "photo"), ("uncertainty", "uncertainty"), ("height", "photo")):
            widget = running.page.panel.view_options.handles["color_by"]
            widget.value = chosen
            running.take(HELLO, replace(DONE, layers=(COLORS,)), replace(VIEW, photo=True))
            assert widget.value == expected
        widget.value = "height"
        running.take(replace(VIEW, photo=True))
        assert widget.value == "height"  # a user has chosen it
        running.page.options = ViewOptions(color_by="photo")
        assert not running.page._extras(running.page.options)[2]  # the patches have colours of their own
    finally:
        running.server.stop()


def test_a_map_without_a_surface_offers_none() -> None:
    running = SurfacePage()
    try:
        running.asked.clear()
        running.take(replace(HELLO, method="log_odds", has_surface=False))
        assert running.page.panel.view_options.handles["draw_as"].options == ("voxels",)
        assert running.page.options.draw_as == "voxels"
        assert running.asked == []
    finally:
        running.server.stop()


def test_while_a_map_has_no_surface_the_panel_says_voxels_and_why() -> None:
    running = SurfacePage()
    try:
        widgets = running.page.panel.view_options.handles
        shown = [widgets[name] for name in ("draw_as", "color_by")]
        for frozen in (1, 2):
            running.take(replace(DONE, no_surface=f"{frozen} images are gone"), OptionsMoved())
            assert [widget.value for widget in shown] == ["voxels", "marginal probability"]
            assert widgets["draw_as"].options == ("voxels",)
            assert widgets["draw_as"].hint.endswith(f"There is no surface: {frozen} images are gone.")
        assert running.page.options.draw_as == "voxels"
        assert "512 voxels" in running.draw(draw_as="voxels", color_by="marginal probability")
        assert "chance that a voxel is occupied" in running.page.panel._legend.content
        running.take(HELLO, DONE)  # another map, which has one
        assert [widget.value for widget in shown] == ["surface", "height"]
        assert "There is no surface" not in widgets["draw_as"].hint
        widgets["baseline"].value = True
        running.take(DONE)
        assert [widget.value for widget in shown] == ["voxels", "marginal probability"]
        assert "both maps are drawn alike" in widgets["draw_as"].hint
        widgets["baseline"].value = False
        running.take(DONE)
        assert [widget.value for widget in shown] == ["surface", "height"]
        widgets["color_by"].value = "uncertainty"
        running.take(replace(DONE, no_surface="all images are gone"))
        assert [widget.value for widget in shown] == ["voxels", "uncertainty"]
    finally:
        running.server.stop()


def test_a_cut_takes_the_triangles_beyond_it_away(drawn: SurfacePage) -> None:
    drawn.take(m.Bricks("map", np.array([[7, -7, 2]], np.int32), np.full((1, 512), -900, np.int16),
                        np.ones((1, 512), np.uint8), np.zeros((0, 3), np.int32)))  # fmt: skip
    drawn.take(patch())
    drawn.take(VIEW)
    assert "2 triangles" in drawn.draw(cut_axis="x", cut_at_m=9.0)
    assert "1 triangles" in drawn.draw(cut_axis="x", cut_at_m=3.85)


def test_the_colours_are_those_of_the_scale(drawn: SurfacePage) -> None:
    photo = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [90, 90, 90]], np.uint8)
    drawn.take(patch(photo))
    drawn.take(VIEW)
    high, occupied = np.array([[0, 0, 3]], np.int32), np.full((1, 512), 900, np.int16)
    drawn.take(m.Bricks("map", high, occupied, np.ones((1, 512), np.uint8), high[:0]))
    drawn.draw(color_by="photo", shade=False)
    assert np.abs(drawn.mesh()[2].astype(int) - photo).max() <= 1
    drawn.draw(color_by="uncertainty", shade=False)
    scale = drawn.page.map.scale if drawn.page.map else None
    assert scale is not None
    # The standard deviations are 0.1, 0.2, 0.3 and 1 cm; equal ratios are equal steps.
    assert (scale.low, scale.high, scale.measure.label) == (
        0.1,
        1.0,
        "uncertainty: standard deviation (cm)",
    )
    expected = scale.colors[np.rint(255 * np.log10([1, 2, 3, 10])).astype(int)]
    assert np.abs(drawn.mesh()[2].astype(int) - expected).max() <= 1
    drawn.draw(shade=False)
    scale = drawn.page.map.scale if drawn.page.map else None
    assert scale is not None
    assert (scale.low, scale.high) == pytest.approx((0.0, 3.2))  # of the voxels: four bricks
    assert re.findall("<span>(.*?)</span>", legend_html(scale)) == ["0", scale.measure.label, "3.2"]
    lit = drawn.mesh()[2].astype(int)
    assert np.abs(lit - scale.colors[[80, 80, 159, 80]]).max() <= 1  # 1 and 2 of 3.2 m
    drawn.draw()
    assert np.abs(drawn.mesh()[2] - lit * (0.62 + 0.38 * 0.8)).max() <= 2


def test_the_surface_has_the_colours_of_the_voxels_behind_it(drawn: SurfacePage) -> None:
    log_odds = np.full((8, 8, 8), -900, np.int16)
    log_odds[7], log_odds[0] = 2353, 0  # 99 in 100, even chances
    brick, seen = np.array([[1, -4, 1]], np.int32), np.zeros((1, 512), np.uint8)
    drawn.take(m.Bricks("map", brick, log_odds.reshape(1, 512), seen, brick[:0]))
    vertices = np.array([[1.55, -3, 1.25], [0.85, -3, 1.25], [2.05, -3, 1.25]], np.float32)
    normals = np.tile(np.array([0, -127, 0], np.int8), (3, 1))
    normals[:] = (0, 127, 0)  # seen from +y: the voxel behind is at y = -3.05
    drawn.take(replace(patch(), vertices_m=vertices, triangles=patch().triangles[:1], normals=normals,
                       std_m=np.zeros(3, np.float32)), VIEW)  # fmt: skip
    drawn.draw(color_by="marginal probability", shade=False)
    sure, unsure, unknown = drawn.mesh()[2].astype(int)
    assert np.abs(sure - (150, 200, 180)).max() <= 2
    assert np.abs(unsure - (240, 110, 40)).max() <= 2
    assert np.abs(unknown - (240, 110, 40)).max() <= 2
    log_odds[7] = 0  # an edit
    drawn.take(m.Bricks("map", brick, log_odds.reshape(1, 512), seen, brick[:0]))
    assert drawn.page.map is not None
    drawn.page.map._sent_at = 0.0
    drawn.page._flush()
    assert np.abs(drawn.mesh()[2][0].astype(int) - (240, 110, 40)).max() <= 2


def test_a_layer_that_pixels_feed_is_a_colouring_of_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    look = OnPage("how warm", "how warm it is.", "warmth", "absent:absent", (("an oven", (200, 0, 0)),))
    made, name = FromPixels("thermal", 1, "absent:Absent", "frozen_heat", ("h",), look), look.coloring
    monkeypatch.setitem(LAYERS, "heat", Layer("uint8", 1, 0, "how warm", made))
    monkeypatch.setitem(COLORINGS, name, runpy.run_path(coloring.__file__)["COLORINGS"][name])
    running = SurfacePage()
    try:
        widget = running.page.panel.view_options.handles["color_by"]
        assert name not in widget.options
        running.take(HELLO, replace(DONE, layers=("heat",)))
        assert name in widget.options
        assert "photo" not in widget.options
        running.take(replace(DONE, layers=("heat", COLORS)), BRICK)
        assert "photo" in widget.options
        widget.value = name
        running.draw(color_by=name, draw_as="voxels", shade=False)
        assert running.asked[-1] == m.Watch(False, None, False, colors=True)
        heat, photo = (np.full((1, 512, 3), level, np.uint8) for level in (200, 50))
        running.take(m.BrickColors((0, 0, 0), BRICK.bricks, heat, "heat"))
        running.take(m.BrickColors((0, 0, 0), BRICK.bricks, photo))
        for each, level in ((name, 200), ("photo", 50)):
            running.draw(color_by=each, draw_as="voxels", shade=False)
            (sent,) = running.page.map.layers["map"]._sent.values()
            assert (sent.colors == level).all()
            assert ("an oven" in running.page.panel._legend.content) == (each == name)
        running.take(HELLO, replace(DONE, voxels=0))  # begun again: its frames may bring what was chosen
        assert (widget.value, "photo" in widget.options) == (name, False)
        running.take(DONE)
        assert (widget.value, name in widget.options) == ("height", False)
    finally:
        running.server.stop()


def test_an_entry_of_the_table_is_a_colouring_of_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its name in the list with its help, its colours on voxels and surface, its legend, and its data."""
    of_z = Measure(
        "place in the chunk", lambda shown, points_m, up: shown.cells[:, 2], lambda low, high: GREYS
    )
    of_x = Measure("metres along x", lambda patch, points_m, up: points_m[:, 0], lambda low, high: GREYS)
    monkeypatch.setitem(COLORINGS, "place", Coloring("where in its chunk.", of_z, of_x, needs="counts"))
    running = SurfacePage()
    try:
        widget = running.page.panel.view_options.handles["color_by"]
        assert "place" in widget.options
        widget.value = "place"
        running.draw(color_by="place", draw_as="voxels", shade=False)
        assert running.asked[-1] == m.Watch(False, None, False, counts=True)
        assert widget.hint.endswith("where in its chunk.")
        (sent,) = running.page.map.layers["map"]._sent.values()
        # The voxels are at 0 to 7 in the chunk.
        np.testing.assert_array_equal(sent.colors[:, 0], np.rint(255.0 * sent.cells[:, 2] / 7))
        assert re.findall("<span>(.*?)</span>", running.page.panel._legend.content) == [
            "0", "place in the chunk", "7",
        ]  # fmt: skip
        running.take(patch(), VIEW)
        running.draw(color_by="place", shade=False)
        assert np.abs(running.mesh()[2][:, 0].astype(int) - 255 * np.array([0, 2, 2, 4]) / 4).max() <= 1
        assert "metres along x" in running.page.panel._legend.content
        running.take(replace(HELLO, counts_keyframes=False))
        assert "place" not in widget.options
    finally:
        running.server.stop()


def test_a_colouring_of_positions_is_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its numbers are those of the voxels' centres, and of the surface's vertices."""
    far = Measure(
        "metres from the origin",
        lambda known, points_m, up: np.linalg.norm(points_m, axis=1),
        lambda low, high: GREYS,
        ends=lambda numbers, heights_m: (0.0, 10.0),
    )
    monkeypatch.setitem(COLORINGS, "far", Coloring("how far it is.", far))
    running = SurfacePage()
    try:
        running.draw(color_by="far", draw_as="voxels", shade=False)
        (sent,) = running.page.map.layers["map"]._sent.values()
        away_m = np.linalg.norm((sent.cells + 0.5) * VOXEL, axis=1)
        assert np.abs(sent.colors[:, 0] - 25.5 * away_m).max() <= 0.51
        running.take(patch(), VIEW)
        running.draw(color_by="far", shade=False)
        away_m = np.linalg.norm(patch().vertices_m, axis=1)
        assert np.abs(running.mesh()[2][:, 0] - 25.5 * away_m).max() <= 1.5
    finally:
        running.server.stop()


def test_a_click_on_the_surface_asks_for_the_ray_to_it(drawn: SurfacePage) -> None:
    drawn.take(patch())
    drawn.take(VIEW)
    drawn.draw()
    drawn.take(Clicked((3.03, -9.0, 2.01), (0.0, 1.0, 0.0), (0.0, 0.0)))
    asked = drawn.asked[-1]
    assert isinstance(asked, m.RayThrough)
    assert asked.point == pytest.approx((3.0, -3.0, 2.0))  # no voxel is near


def test_a_click_on_the_surface_beside_an_occupied_voxel_asks_for_that_voxel(drawn: SurfacePage) -> None:
    log_odds = np.full((8, 8, 8), -900, np.int16)
    log_odds[1, 2, 3] = 900  # its centre is at 0.95, -2.95, 1.15 m
    brick = np.array([[1, -4, 1]], np.int32)
    seen = np.zeros((1, 512), np.uint8)
    drawn.take(m.Bricks("map", brick, log_odds.reshape(1, 512), seen, brick[:0]))
    for aside_m, clicked, state in (
        (0.06, (0.95, -2.95, 1.15), "occupied"),
        (0.2, (0.95, -2.95, 1.35), "free"),
    ):
        vertices = patch().vertices_m - patch().vertices_m[0] + np.float32([0.95, -2.95, 1.15 + aside_m])
        drawn.take(replace(patch(), vertices_m=vertices), VIEW)
        drawn.draw()
        drawn.take(Clicked((0.95, -9.0, 1.15 + aside_m), (0.0, 1.0, 0.0), (0.0, 0.0)))
        assert drawn.asked[-1].point == pytest.approx(clicked)
        assert drawn.page._facts()["state"] == state


OF_MAP = {"draw_as", "color_by", "threshold", "size", "shade", "pictures"}


def test_options_without_effect_are_hidden(drawn: SurfacePage) -> None:
    def used() -> set[str]:
        handles = drawn.page.panel.view_options.handles
        return {name for name, handle in handles.items() if handle.visible} & OF_MAP

    drawn.take(status(finished=False))
    drawn.draw()
    assert used() == OF_MAP  # voxels take the place of the surface
    drawn.take(status())
    assert drawn.draw().startswith("2 tri")
    assert used() == OF_MAP - {"threshold", "size"}
    drawn.draw(map=False)
    assert used() == {"pictures"}
    assert not drawn.page.panel._legend.content
    drawn.draw(draw_as="voxels", keyframes=False)
    assert used() == OF_MAP - {"pictures"}
