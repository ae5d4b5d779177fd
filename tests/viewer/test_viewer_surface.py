"""The measured surface on the page: meshes in the colours of the scale, in the place of voxels."""

import json
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from handled_page import HandledPage

from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.live.panel import Clicked
from taichi_mrf.viewer.scene.coloring import ViewOptions
from taichi_mrf.viewer.scene.surface_layer import before_tone_mapping, unlit_glb

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
    has_colors=True,
    has_surface=True,
)
VIEW = m.SurfaceView(
    eye_m=np.array([3.0, -9.0, 5.0]),
    target_m=np.array([3.0, -3.0, 1.5]),
    up=np.array([0.0, 0.0, 1.0]),
    light=np.array([0.6, -0.8, 0.0]),
    fov_rad=0.6,
    floor_m=1.0,
    range_m=2.0,
    photo=False,
)
CHUNK = (0, -1, 0)


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
        brick, packed = np.zeros((1, 3), np.int32), np.full((1, 512), 900, np.int16)
        self.take(m.Bricks("map", brick, packed, np.ones((1, 512), np.uint8), brick[:0]))

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
    assert scene.scale.color_by == "probability"  # voxels show how sure the map is while it grows
    drawn.take(VIEW)
    assert drawn.draw() == "2 triangles of the measured surface shown"
    assert (drawn.is_visible("/voxels"), drawn.is_visible("/surface")) == (False, True)
    vertices, triangles, _ = drawn.mesh()
    np.testing.assert_allclose(vertices[triangles], patch().vertices_m[patch().triangles], atol=1e-6)
    assert scene.scale.color_by == "height"
    assert drawn.draw(look="voxels by height") == "512 voxels shown"
    assert scene.scale.color_by == "height"
    assert (drawn.is_visible("/voxels"), drawn.is_visible("/surface")) == (True, False)
    drawn.take(patch(empty=True))
    assert drawn.draw() == "512 voxels shown"


def status(**changes: object) -> m.Status:
    done = m.Status("", 1.0, 1, 1, 1, 0, 0.0, 512, 1, 1.0, paused=False, finished=True, pending=False)
    return replace(done, **changes)  # type: ignore[arg-type]


def test_while_frames_are_read_voxels_are_shown(drawn: SurfacePage) -> None:
    drawn.take(patch())
    drawn.take(VIEW)
    for changes, shown in (
        ({"finished": False}, "512 voxels"),
        ({"paused": True, "finished": False}, "2 tri"),
    ):
        drawn.take(status(**changes))
        assert drawn.draw().startswith(shown)


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
        photo, other = "surface in photo colours", "voxels by uncertainty"
        for chosen, expected in ((None, photo), (other, other), (None, photo)):
            widget = running.page.panel.view_options.handles["look"]
            widget.value = chosen or ViewOptions().look
            running.take(replace(HELLO, has_colors=True))
            running.take(replace(VIEW, photo=True))
            assert widget.value == expected
        widget.value = "surface by height"
        running.take(replace(VIEW, photo=True))
        assert widget.value == "surface by height"  # a user has chosen it
        running.page.options = ViewOptions(photo)
        assert not running.page._extras(running.page.options)[2]  # the patches have colours of their own
    finally:
        running.server.stop()


def test_a_map_without_a_surface_offers_none() -> None:
    running = SurfacePage()
    try:
        running.asked.clear()
        running.take(replace(HELLO, method="log_odds", has_surface=False))
        looks = running.page.panel.view_options.handles["look"].options
        assert not any("surface" in look for look in looks)
        assert running.page.options.look == looks[0] == "voxels by height"
        assert running.asked == []
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
    drawn.draw(look="surface in photo colours", shade=False)
    assert np.abs(drawn.mesh()[2].astype(int) - photo).max() <= 1
    drawn.draw(look="surface by uncertainty", shade=False)
    scale = drawn.page.map.scale if drawn.page.map else None
    assert scale is not None
    assert (scale.high, scale.label) == (0.9, "standard deviation (cm)")  # nearly all lie below
    expected = scale.colors[np.rint(255 * np.array([1, 2, 3, 9]) / 9).astype(int)]
    assert np.abs(drawn.mesh()[2].astype(int) - expected).max() <= 1
    drawn.draw(shade=False)
    scale = drawn.page.map.scale if drawn.page.map else None
    assert scale is not None
    assert (scale.high, scale.label) == (2.0, "height above the lowest surface (m)")
    lit = drawn.mesh()[2].astype(int)
    assert np.abs(lit - scale.colors[[0, 0, 128, 0]]).max() <= 1
    drawn.draw()
    assert np.abs(drawn.mesh()[2] - lit * (0.62 + 0.38 * 0.8)).max() <= 2


def test_a_click_on_the_surface_asks_for_the_ray_to_it(drawn: SurfacePage) -> None:
    drawn.take(patch())
    drawn.take(VIEW)
    drawn.draw()
    drawn.take(Clicked((3.03, -9.0, 2.01), (0.0, 1.0, 0.0), (0.0, 0.0)))
    asked = drawn.asked[-1]
    assert isinstance(asked, m.RayThrough)
    assert asked.point == pytest.approx((3.0, -3.0, 2.0))


def test_options_without_effect_are_hidden(drawn: SurfacePage) -> None:
    def used() -> set[str]:
        handles = drawn.page.panel.view_options.handles
        return {name for name in ("threshold", "size", "shade") if handles[name].visible}

    drawn.take(status(finished=False))
    drawn.draw()
    assert used() == {"threshold", "size", "shade"}  # voxels take the place of the surface
    drawn.take(status())
    assert drawn.draw().startswith("2 tri")
    assert used() == {"shade"}
    drawn.draw(look="measured points of the keyframe")
    assert used() == set()
    drawn.draw(look="voxels by height")
    assert used() == {"threshold", "size", "shade"}
