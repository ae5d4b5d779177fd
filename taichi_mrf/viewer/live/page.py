"""The live page: the one owner of its scene and its widgets.

Everything that happens, an update from the mapper or something that a viewer did, goes into one inbox and
is dealt with on one thread, so that no two ever change the same node.
"""

import time
from collections.abc import Callable

import numpy as np
import viser

from taichi_mrf.geometry.up import up_of
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.events import Chosen, Clicked, Dragged, Event, Joined, OptionsMoved, Pressed
from taichi_mrf.viewer.live.options import ViewOptions
from taichi_mrf.viewer.live.panel import CHOSEN_KEYFRAME, POSITION_STEP_M, SPEEDS, Panel
from taichi_mrf.viewer.notices import pop_up
from taichi_mrf.viewer.scene.coloring import Scale, legend_html
from taichi_mrf.viewer.scene.keyframe_layer import KeyframeLayer, Placement
from taichi_mrf.viewer.scene.map_scene import MapScene
from taichi_mrf.viewer.scene.picking import first_pixel, first_voxel
from taichi_mrf.viewer.scene.viewpoint import ViewpointController
from taichi_mrf.viewer.transport.downloads import Downloads
from taichi_mrf.viewer.transport.inbox import Inbox, Item

_HEAD_START_S = 0.01
"""What the event loop needs to send a sentence before the voxels that it is about: they go out in one
piece, and a browser that draws by software is busy with them for half a second."""


class Page:
    """One page, for all browsers that look at it."""

    def __init__(self, server: viser.ViserServer, ask: Callable[[m.Request], None]) -> None:
        """``ask`` sends a request to the mapper, and does not wait."""
        self._server, self._ask = server, ask
        self.inbox = Inbox()
        self._options = ViewOptions()
        self._panel = Panel(server.gui, server.scene, self.inbox.put)
        self._downloads = Downloads(server, lambda text: self.inbox.put(m.Notice(text, "error")))
        self._keyframes = KeyframeLayer(server.scene)
        self._eye = ViewpointController(server)
        self._map: MapScene | None = None
        self._voxel_size = 0.0
        self._two = False
        self._scale: Scale | None = None
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.on_click()(self._scene_clicked)
        server.on_client_connect(lambda client: self.inbox.put(Joined(client.client_id)))

    def run(self) -> None:
        """Serve until None is put into the inbox."""
        while True:
            batch = self.inbox.wait(None if self._map is None else self._map.patience())
            self._downloads.tick()
            for item in _latest(batch):
                if item is None:
                    return
                self._take(item)
            self._flush()

    def _take(self, item: m.Update | Event) -> None:
        """Deal with one thing."""
        if isinstance(item, m.Hello):
            self._begin(item)
        elif self._map is None:
            return
        elif isinstance(item, m.Bricks):
            self._map.take(item)
        elif isinstance(item, m.KeyframeInfo):
            self._take_keyframe(item)
        elif isinstance(item, m.CurrentCamera):
            self._keyframes.show_camera(item)
            self._eye.camera_moved(item.T_world_camera, self._options.follow)
        elif isinstance(item, m.Status):
            self._panel.show_status(item)
        elif isinstance(item, m.Notice):
            self._notify(item)
        elif isinstance(item, m.RayAnswer):
            self._panel.ray.show(item)
        elif isinstance(item, m.Images):
            self._panel.show_images(item)
        elif isinstance(item, m.File):
            self._downloads.send(item.client, item.name, item.content)
        elif isinstance(item, OptionsMoved):
            self._options_moved()
        elif isinstance(item, Pressed):
            self._pressed(item)
        elif isinstance(item, Chosen):
            self._chosen(item.widget)
        elif isinstance(item, Clicked):
            self._clicked(item)
        elif isinstance(item, Dragged):
            self._dragged()
        elif isinstance(item, Joined):
            self._eye.joined(item.client)

    def _begin(self, hello: m.Hello) -> None:
        """Start with an empty map."""
        if self._map is not None:
            self._map.clear()
        self._map, self._voxel_size = MapScene(self._server, hello), hello.voxel_size
        self._keyframes.clear()
        self._panel.ray.clear()
        self._panel.show_hello(hello)
        self._panel.show_keyframes({}, None)

    def _take_keyframe(self, keyframe: m.KeyframeInfo) -> None:
        if not self._keyframes.keyframes:
            self._eye.set_up(up_of(keyframe.T_world_camera))
            self._keyframes.chosen = keyframe.id
        self._keyframes.put(keyframe)
        self._keyframes.draw_way()
        self._panel.show_keyframes(self._keyframes.keyframes, self._keyframes.chosen)

    def _flush(self) -> None:
        """Draw what has changed of the map, if it is time."""
        if self._map is None:
            return
        crossed = self._keyframes.roster.crossed()
        if not self._map.flush(self._options, self._eye.up, crossed, self._show_counts):
            return
        two = bool(self._map.layers["beside"].store.chunks)
        if two != self._two:
            self._two = two
            self._eye.look_at_everything()
        box = self._map.box_m()
        if box is not None:
            self._eye.map_grew(*box)
        scale = self._map.scale
        if scale is not None and (self._scale is None or scale.legend() != self._scale.legend()):
            self._scale = scale
            self._panel.show_legend(legend_html(scale))

    def _show_counts(self) -> None:
        assert self._map is not None
        shown = {name: layer.voxels_shown for name, layer in self._map.layers.items()}
        self._panel.show_counts(shown["map"], shown["beside"], self._downloads.is_recording)
        self._server.flush()
        time.sleep(_HEAD_START_S)

    def _notify(self, notice: m.Notice) -> None:
        self._panel.show_notice(notice)
        pop_up(self._server, notice)

    def _options_moved(self) -> None:
        before, self._options = self._options, self._panel.options()
        if self._options.dark != before.dark:
            self._server.gui.configure_theme(
                dark_mode=self._options.dark, show_share_button=False, show_logo=False
            )
        if self._options.follow and not before.follow:
            self._eye.follow()
        if _extras(self._options) != _extras(before):
            self._watch()
        self._keyframes.show_pictures(self._options.pictures)
        if self._map is not None:
            self._map.look_changed()

    def _pressed(self, pressed: Pressed) -> None:
        keyframe, client = self._keyframes.chosen, pressed.client
        simple: dict[str, m.Request] = {
            "Go": m.Pause(False),
            "Pause": m.Pause(True),
            "Step": m.Step(),
            "Reset": m.Reset(),
        }
        if pressed.button in simple:
            self._ask(simple[pressed.button])
        elif pressed.button == "Map":
            self._ask(m.Save("map", client))
        elif pressed.button == "Voxels":
            self._ask(m.Save("ply", client))
        elif pressed.button == "Picture":
            self._downloads.picture(client)
        elif pressed.button == "Page":
            self._downloads.page(client, self._options.dark)
        elif pressed.button == "Recording":
            self._downloads.toggle_recording(client)
            self._show_counts()
        elif keyframe is None:
            self._notify(m.Notice("There is no keyframe yet.", "warning"))
        elif pressed.button == "On/off":
            self._ask(m.Switch(keyframe, self._keyframes.keyframes[keyframe].state == "off"))
        elif pressed.button == "Freeze":
            self._ask(m.Freeze(keyframe))
        elif pressed.button == "Move":
            self._toggle_gizmo()
        elif pressed.button == "Put back":
            self._ask(m.Move(keyframe, self._keyframes.roster.recorded[keyframe]))
        elif pressed.button == "Ray of pixel":
            u, v = self._panel.pixel.value
            self._ask(m.PixelRay(keyframe, u, v))

    def _toggle_gizmo(self) -> None:
        if self._keyframes.gizmo is not None:
            self._keyframes.release()
            return
        gizmo = self._keyframes.grab()
        if gizmo is not None:
            gizmo.on_update(lambda event: self.inbox.put(Dragged()) if event.phase == "end" else None)

    def _dragged(self) -> None:
        gizmo, keyframe = self._keyframes.gizmo, self._keyframes.chosen
        if gizmo is not None and keyframe is not None:
            place = Placement(np.array(gizmo.wxyz), np.array(gizmo.position))
            self._ask(m.Move(keyframe, place.pose()))

    def _chosen(self, widget: str) -> None:
        if widget == "speed":
            self._ask(m.Speed(SPEEDS[self._panel.speed.value]))
        elif widget == "images":
            if not self._panel.images.value:
                self._panel.hide_images()
            self._watch()
        elif widget == "keyframe":
            self._choose(self._panel.chosen_keyframe())
        elif widget == "position" and self._keyframes.chosen is not None:
            T = self._keyframes.keyframes[self._keyframes.chosen].T_world_camera.copy()
            typed = np.array(self._panel.position.value)
            # The box holds rounded numbers, and to round the other two coordinates is not to move them.
            T[:3, 3] = np.where(np.abs(typed - T[:3, 3]) > 0.51 * POSITION_STEP_M, typed, T[:3, 3])
            self._ask(m.Move(self._keyframes.chosen, T))

    def _choose(self, keyframe: int | None) -> None:
        self._keyframes.release()
        self._keyframes.choose(keyframe)
        self._panel.show_keyframes(self._keyframes.keyframes, keyframe)
        if self._panel.images.value and self._panel.view.value == CHOSEN_KEYFRAME:
            self._watch()

    def _watch(self) -> None:
        """Tell the mapper which extras are wanted."""
        view = self._keyframes.chosen if self._panel.view.value == CHOSEN_KEYFRAME else None
        beside, counts = _extras(self._options)
        self._ask(m.Watch(self._panel.images.value, view, beside, counts))

    def _scene_clicked(self, event: viser.SceneClickEvent) -> None:
        self.inbox.put(Clicked(event.ray_origin, event.ray_direction))

    def _clicked(self, click: Clicked) -> None:
        """A picture of a keyframe chooses it and that pixel; a voxel asks for a ray to it."""
        assert self._map is not None
        shown = [k for k in self._keyframes.keyframes.values() if k.state != "frozen"]
        pixel = first_pixel(click.origin, click.direction, shown)
        points = self._map.layers["map"].points()
        voxel = first_voxel(click.origin, click.direction, points, self._voxel_size)
        if pixel is not None and (voxel is None or pixel.range_m < voxel[1]):
            self._choose(pixel.keyframe)
            self._panel.pixel.value = (round(pixel.u), round(pixel.v))
            self._ask(m.PixelRay(pixel.keyframe, pixel.u, pixel.v))
        elif voxel is not None:
            point = voxel[0]
            chosen = self._keyframes.chosen
            self._ask(m.RayThrough((point[0], point[1], point[2]), click.origin, chosen))


def _extras(options: ViewOptions) -> tuple[bool, bool]:
    """Whether the options want the other map beside, and the counts of keyframes."""
    return options.beside, options.color_by == "keyframes"


def _latest(batch: list[Item]) -> list[Item]:
    """The batch without what a later item of it makes superfluous."""
    kept: list[Item] = []
    passing: set[type] = set()
    for item in reversed(batch):
        if isinstance(item, m.Status | m.CurrentCamera | m.Images | OptionsMoved):
            if type(item) in passing:
                continue
            passing.add(type(item))
        kept.append(item)
    return kept[::-1]
