"""The tuning page: the one owner of its scene and its widgets, as page.py is of the live page's.

Everything that happens goes into one inbox and is dealt with on one thread. The page holds the parameters
that the sliders stand for, exactly: a slider's steps touch only the parameter that was moved.
"""

from collections.abc import Callable

import viser

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import up_of
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.events import Chosen, Event, Joined, KnobMoved, OptionsMoved, Pressed
from taichi_mrf.viewer.live.options import ViewOptions
from taichi_mrf.viewer.notices import pop_up
from taichi_mrf.viewer.scene.coloring import Scale, legend_html
from taichi_mrf.viewer.scene.keyframe_layer import KeyframeLayer
from taichi_mrf.viewer.scene.map_scene import MapScene
from taichi_mrf.viewer.scene.viewpoint import ViewpointController
from taichi_mrf.viewer.transport.downloads import Downloads
from taichi_mrf.viewer.transport.inbox import Inbox
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.panel import TunePanel


class TunePage:
    """One page, for all browsers that look at it."""

    def __init__(self, server: viser.ViserServer, ask: Callable[[m.Request], None]) -> None:
        """``ask`` sends a request to the tuning process, and does not wait."""
        self._server, self._ask = server, ask
        self.inbox = Inbox()
        self._options, self._config = ViewOptions(), Config()
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self._panel = TunePanel(server.gui, self._config, self.inbox.put)
        self._downloads = Downloads(server, lambda text: self.inbox.put(m.Notice(text, "error")))
        self._keyframes = KeyframeLayer(server.scene)
        self._eye = ViewpointController(server)
        self._map: MapScene | None = None
        self._hello: m.Hello | None = None
        self._scale: Scale | None = None
        self._tuning: t.Tuning | None = None
        self._tries: dict[int, t.Tried] = {}
        self._shown: int | None = None
        self._pinned: int | None = None
        self._moved, self._table_old = False, False
        self._asked: Config | None = None
        server.scene.configure_default_lights(cast_shadow=False)
        server.on_client_connect(lambda client: self.inbox.put(Joined(client.client_id)))

    def run(self) -> None:
        """Serve until None is put into the inbox."""
        while True:
            batch = self.inbox.wait(None if self._map is None else self._map.patience())
            for item in batch:
                if item is None:
                    return
                self._take(item)
            self._ask_for_a_try()
            if self._table_old:
                self._panel.show_tries(list(self._tries.values()), self._shown, self._pinned)
                self._table_old = False
            self._flush()

    def _take(self, item: m.Update | Event) -> None:
        """Deal with one thing."""
        if isinstance(item, t.Tuning):
            self._begin(item)
        elif isinstance(item, m.Hello):
            self._hello = item
            self._keyframes.clear()
        elif isinstance(item, m.Bricks):
            self._take_bricks(item)
        elif isinstance(item, m.KeyframeInfo):
            self._take_keyframe(item)
        elif isinstance(item, t.Activity):
            self._panel.show_activity(item)
            if not item.busy:  # whatever was asked for has been shown, or could not be
                self._asked = None
        elif isinstance(item, t.Tried):
            self._tries[item.number] = item
            # First scores are news although the map is not there yet; those of a search are one of many.
            self._shown = item.number if item.by != "search" or self._shown is None else self._shown
            self._table_old = True
        elif isinstance(item, t.Pinned):
            self._pinned, self._table_old = item.number, True
        elif isinstance(item, t.Chosen):
            self._show_chosen(item)
        elif isinstance(item, t.Residuals):
            self._panel.noise.show(item)
        elif isinstance(item, t.HeldOutView):
            self._panel.show_view(item)
        elif isinstance(item, m.Notice):
            self._notify(item)
        elif isinstance(item, m.File):
            self._downloads.send(item.client, item.name, item.content)
        elif isinstance(item, KnobMoved):
            self._knob_moved(item.name)
        elif isinstance(item, OptionsMoved):
            self._options_moved()
        elif isinstance(item, Pressed):
            self._pressed(item)
        elif isinstance(item, Chosen) and item.widget == "view":
            self._look_at(self._panel.view.value)
        elif isinstance(item, Joined):
            self._eye.joined(item.client)

    def _begin(self, tuning: t.Tuning) -> None:
        """Start with an empty table."""
        self._tuning, self._config = tuning, tuning.config
        self._tries.clear()
        self._shown = self._pinned = None
        self._moved, self._table_old, self._asked = False, True, None
        self._panel.show_tuning(tuning)
        self._panel.show_config(tuning.config)

    def _take_bricks(self, bricks: m.Bricks) -> None:
        """The old map stays until the first of the new one is here, or the scene would be empty meanwhile."""
        if self._hello is not None:
            if self._map is not None:
                self._map.clear()
            self._map, self._hello = MapScene(self._server, self._hello), None
        if self._map is not None:
            self._map.take(bricks)

    def _take_keyframe(self, keyframe: m.KeyframeInfo) -> None:
        if not self._keyframes.keyframes:
            up = up_of(keyframe.T_world_camera)
            if up != self._eye.up or self._map is None or self._scale is None:
                self._eye.set_up(up)
        self._keyframes.put(keyframe)
        self._keyframes.draw_way()

    def _show_chosen(self, chosen: t.Chosen) -> None:
        """Map, plot and pictures are of another try; the sliders follow, unless they have been moved since
        and another try is on its way."""
        self._shown, self._table_old = chosen.number, True
        if self._asked == chosen.config:
            self._asked = None
        if not self._moved and self._asked is None and self._config != chosen.config:
            self._config = chosen.config
            self._panel.show_config(chosen.config)

    def _knob_moved(self, name: str) -> None:
        try:
            changed = self._panel.applied(name, self._config)
        except ConfigError as error:
            self._notify(m.Notice(str(error), "error"))
            self._panel.show_config(self._config)
            return
        if changed != self._config:
            self._config, self._moved = changed, True
            self._panel.follow(changed)

    def _ask_for_a_try(self) -> None:
        """Once for all that was moved in the same moment."""
        if self._moved:
            self._moved, self._asked = False, self._config
            self._ask(t.Try(self._config))

    def _pressed(self, pressed: Pressed) -> None:
        number = self._panel.chosen_try()
        if pressed.button == "Stop the search":
            self._ask(t.StopSearch())
        elif pressed.button == "Use these frames":
            self._choose_frames()
        elif number is None:
            self._notify(m.Notice("There is no try yet.", "warning"))
        elif pressed.button == "Restore":
            self._config, self._moved = self._tries[number].config, True
            self._panel.show_config(self._config)
        elif pressed.button == "Pin":
            self._ask(t.Pin(number))
        elif pressed.button == "Save YAML":
            self._ask(t.SaveTries("yaml", number, pressed.client))
        elif pressed.button == "Save CSV":
            self._ask(t.SaveTries("csv", number, pressed.client))

    def _choose_frames(self) -> None:
        try:
            self._ask(t.ChooseFrames(self._panel.frame_choice()))
        except ConfigError as error:
            self._notify(m.Notice(str(error), "error"))

    def _look_at(self, name: str) -> None:
        if self._tuning is not None and name in self._tuning.held_out:
            self._ask(t.LookAt(self._tuning.held_out.index(name)))

    def _options_moved(self) -> None:
        before, self._options = self._options, self._panel.options()
        if self._options.dark != before.dark:
            self._server.gui.configure_theme(
                control_width="large", dark_mode=self._options.dark, show_share_button=False, show_logo=False
            )
        self._keyframes.show_pictures(self._options.pictures)
        if self._map is not None:
            self._map.look_changed()

    def _flush(self) -> None:
        """Draw what has changed of the map, if it is time."""
        if self._map is None:
            return
        crossed = self._keyframes.roster.crossed()
        if not self._map.flush(self._options, self._eye.up, crossed):
            return
        self._panel.show_counts(self._map.layers["map"].voxels_shown)
        box = self._map.box_m()
        if box is not None:
            self._eye.map_grew(*box)
        scale = self._map.scale
        if scale is not None and (self._scale is None or scale.legend() != self._scale.legend()):
            self._scale = scale
            self._panel.show_legend(legend_html(scale))

    def _notify(self, notice: m.Notice) -> None:
        self._panel.show_notice(notice)
        pop_up(self._server, notice)
