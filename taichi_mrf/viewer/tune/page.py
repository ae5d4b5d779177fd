"""The tuning page: what updates and events do to its scene and its widgets.

The page holds the exact configuration that the sliders stand for: a slider has steps, and using it changes
only its own parameter.
"""

from collections.abc import Callable
from dataclasses import replace

import viser

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.up import up_of
from taichi_mrf.sensor.camera import forwards
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.scene.base_page import BasePage
from taichi_mrf.viewer.scene.base_panel import Inbox
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.panel import KnobMoved, TunePanel


class TunePage(BasePage[TunePanel]):
    """One page for all browsers that show it."""

    control_width = "large"

    def __init__(self, server: viser.ViserServer, ask: Callable[[m.Request], None]) -> None:
        """``ask`` sends a request to the tuning process and does not wait."""
        inbox, self._config = Inbox(), Config()
        super().__init__(server, ask, inbox, TunePanel(server.gui, self._config, inbox.put))
        self._hello: m.Hello | None = None
        self._has_view = False
        self._tuning: t.Tuning | None = None
        self._tries: dict[int, t.Tried] = {}
        self._shown: int | None = None
        self._pinned: int | None = None
        self._moved, self._table_old = False, False
        self._asked: Config | None = None
        self.handlers |= {
            t.Tuning: self._begin,
            m.Hello: self._expect_map,
            m.Bricks: self._take_bricks,
            m.KeyframeInfo: self._take_keyframe,
            t.Activity: self._take_activity,
            t.Tried: self._take_try,
            t.Pinned: self._take_pinned,
            t.Chosen: self._show_chosen,
            t.Residuals: self.panel.noise.show,
            t.HeldOutView: self.panel.show_view,
            t.Verdict: self.panel.show_verdict,
            KnobMoved: lambda moved: self._knob_moved(moved.name),
        }
        self.actions |= {
            "Start a search": lambda client: self._begin_anew(client, self.panel.search.value),
            "Save best.yaml": lambda client: ask(t.SaveTries("best", 0, client)),
            "Stop the search": lambda client: ask(t.StopSearch()),
            "Use these frames": lambda client: self._begin_anew(client, self._frames),
            "Held-out view": lambda client: self._look_at(self.panel.view.value),
            "Restore": lambda client: self._with_try(self._restore),
            "Pin": lambda client: self._with_try(lambda number: ask(t.Pin(number))),
            "Save YAML": lambda client: self._with_try(lambda n: ask(t.SaveTries("yaml", n, client))),
            "Save CSV": lambda client: self._with_try(lambda n: ask(t.SaveTries("csv", n, client))),
        }

    def batch_done(self) -> None:
        """Ask for one try for all parameters that moved together, and show the table once for all tries."""
        if self._moved:
            self._moved, self._asked = False, self._config
            self.ask(t.Try(self._config))
        if self._table_old:
            self.panel.show_tries(list(self._tries.values()), self._shown, self._pinned)
            self._table_old = False

    def _begin(self, tuning: t.Tuning) -> None:
        """Start with an empty table; other frames of the same recording keep the user's view."""
        self._has_view &= self._tuning is not None and tuning.source == self._tuning.source
        self._tuning, self._config = tuning, tuning.config
        self._tries.clear()
        self._shown = self._pinned = None
        self._moved, self._table_old, self._asked = False, True, None
        self.show_source(tuning.source)
        self.panel.show_tuning(tuning)
        self.panel.show_config(tuning.config)

    def _expect_map(self, hello: m.Hello) -> None:
        """The old map stays until the first bricks of the new one arrive, or the scene would be empty."""
        self._hello = hello
        self.keyframes.clear()
        self.panel.offer(replace(hello, counts_keyframes=False))  # these are not sent here
        self.options = self.panel.view_options.value()

    def _take_bricks(self, bricks: m.Bricks) -> None:
        if self._hello is not None:
            self.begin_map(self._hello)
            self._hello = None
        if self.map is not None:
            self.map.take(bricks)

    def _take_keyframe(self, keyframe: m.KeyframeInfo) -> None:
        if not self._has_view:  # another map keeps the user's view
            self._look_inside(keyframe)
        self.keyframes.put(keyframe)
        self.keyframes.draw_path()

    def _look_inside(self, keyframe: m.KeyframeInfo) -> None:
        """Begin where the first keyframe was, and a little behind: from outside, walls hide a room."""
        self._has_view = True
        self.viewpoint.set_up(up_of(keyframe.T_world_camera, keyframe.camera.up))
        self.viewpoint.camera_moved(keyframe.T_world_camera, forwards(keyframe.camera))
        self.viewpoint.set_following(True)

    def _take_activity(self, activity: t.Activity) -> None:
        self.panel.show_tuning_activity(activity)
        if not activity.busy:  # what was asked for has been shown or has failed
            self._asked = None

    def _take_try(self, tried: t.Tried) -> None:
        """The scores of a first look are shown before its map arrives; tries of a search are only listed."""
        self._tries[tried.number] = tried
        if tried.by != "search" or self._shown is None:
            self._shown = tried.number
        self._table_old = True

    def _take_pinned(self, pinned: t.Pinned) -> None:
        self._pinned, self._table_old = pinned.number, True

    def _show_chosen(self, chosen: t.Chosen) -> None:
        """Map, plot and pictures are now those of this try. The sliders follow, unless a user has moved them
        since and another try is coming."""
        self._shown, self._table_old = chosen.number, True
        if self._asked == chosen.config:
            self._asked = None
        if not self._moved and self._asked is None and self._config != chosen.config:
            self._config = chosen.config
            self.panel.show_config(chosen.config)

    def _knob_moved(self, name: str) -> None:
        try:
            changed = self.panel.knobs.applied(name, self._config)
        except ConfigError as error:
            self.notify(m.Notice(str(error), "error"))
            self.panel.show_config(self._config)
            return
        if changed != self._config:
            self._config, self._moved = changed, True
            self.panel.follow(changed)

    def _with_try(self, use: Callable[[int], None]) -> None:
        """Do something with the try that the dropdown shows."""
        number = self.panel.chosen_try()
        if number is None:
            self.notify(m.Notice("There is no try yet.", "warning"))
        else:
            use(number)

    def _restore(self, number: int) -> None:
        self._config, self._moved = self._tries[number].config, True
        self.panel.show_config(self._config)

    def _frames(self) -> t.ChooseFrames:
        return t.ChooseFrames(self.panel.frames.value())

    def _begin_anew(self, client: int, wanted: Callable[[], m.Request]) -> None:
        """Ask before the tries that were made are lost with the table."""
        try:
            request = wanted()
        except ConfigError as error:
            self.notify(m.Notice(str(error), "error"))
            return
        self.request(
            client,
            request,
            len(self._tries) > 1,
            "Discard the tries?",
            f"This empties the table of {len(self._tries)} tries, because scores on other frames are not "
            "comparable. To keep them, save the table first.",
            "Discard them",
            "Keep the tries",
        )

    def _look_at(self, name: str) -> None:
        if self._tuning is not None and name in self._tuning.held_out:
            self.ask(t.LookAt(self._tuning.held_out.index(name)))
