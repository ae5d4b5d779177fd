"""Base of the live page and the tuning page: one inbox, one thread, one scene; and the viewer's process,
which has a page on its main thread and a thread that reads what the mapping process sends.

All updates from the mapping process and all events from browsers go into one inbox and are handled on one
thread, so no two threads ever change the same node. A page registers a handler for each kind of item and for
each action.
"""

import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar, get_args

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.scene.base_panel import (
    AGREE,
    DECLINE,
    BasePanel,
    Inbox,
    Item,
    Joined,
    OptionsMoved,
    Used,
)
from taichi_mrf.viewer.scene.coloring import Scale, key_html, legend_html
from taichi_mrf.viewer.scene.keyframe_layer import KeyframeLayer
from taichi_mrf.viewer.scene.map_scene import MapScene
from taichi_mrf.viewer.scene.view_options import ViewOptions, drawings_of
from taichi_mrf.viewer.scene.viewpoint import Side, ViewpointController
from taichi_mrf.viewer.transport.downloads import Downloads
from taichi_mrf.viewer.transport.pulse import Pulse
from taichi_mrf.viewer.transport.server import start_server

P = TypeVar("P", bound=BasePanel)

_HEAD_START_S = 0.01
"""Delay that lets the new count reach the browser before the voxel data: a browser that draws by software is
busy with the voxels for half a second."""

_POP_UP_COLORS: dict[str, Literal["blue", "yellow", "red"]] = {
    "info": "blue",
    "warning": "yellow",
    "error": "red",
}
POP_UP_S = 8.0
_LONGEST_POP_UP = 500

_TOP, _BOTTOM, _BACKDROP_ROWS = (52, 58, 68), (104, 112, 124), 256

_ONLY_THE_LATEST = (m.Status, m.CurrentCamera, m.Images, m.TimeSpan, m.SceneChanges, OptionsMoved)
"""Of several of these that wait, only the latest is handled."""


class BasePage(Generic[P]):
    """One page for all browsers that show it; owns the scene, the panel and the inbox."""

    control_width: ClassVar[Literal["small", "medium", "large"]] = "medium"

    def __init__(
        self, server: viser.ViserServer, ask: Callable[[m.Request], None], inbox: Inbox, panel: P
    ) -> None:
        """``ask`` sends a request to the mapping process and does not wait; ``panel`` puts events into
        ``inbox``."""
        self.server, self.ask, self.inbox, self.panel = server, ask, inbox, panel
        self.options = ViewOptions()
        self.downloads = Downloads(server, lambda text: inbox.put(m.Notice(text, "error")))
        self.keyframes = KeyframeLayer(server.scene)
        self.viewpoint = ViewpointController(server)
        self.map: MapScene | None = None
        self._explained: tuple[Scale | None, bool, frozenset[str]] | None = None  # by the legend
        self._with_baseline = False
        self._cut_for_space = False  # whether the cut was made to show free space
        self.actions: dict[str, Callable[[int], None]] = {
            BasePanel.DARK_OR_LIGHT[0]: self._turn_colors,
            AGREE: panel.agree,
            DECLINE: panel.close_question,
            **{side.capitalize(): partial(self.look_from, side) for side in get_args(Side)},
        }
        """Function of each action, given the client that asked for it."""
        self.handlers: dict[type, Callable[[Any], None]] = {
            m.Notice: self.notify,
            m.File: lambda file: self.downloads.send(file.client, file.name, file.content),
            OptionsMoved: lambda moved: self._take_options(),
            Used: lambda used: self.actions[used.action](used.client),
            Joined: lambda joined: self.viewpoint.joined(joined.client),
        }
        """Handler of each kind of update and event; other kinds are ignored."""
        self._theme: Any = {"show_logo": False, "show_share_button": False}
        server.gui.configure_theme(control_width=self.control_width, **self._theme)
        server.scene.set_background_image(_backdrop(), format="png")
        server.scene.configure_default_lights(cast_shadow=False)
        panel.show_cut(None)
        server.on_client_connect(lambda client: inbox.put(Joined(client.client_id)))

    def run(self) -> None:
        """Serve until None is put into the inbox."""
        while True:
            batch = self.inbox.wait(None if self.map is None else self.map.patience())
            self.downloads.tick()
            for item in _latest(batch):
                if item is None:
                    return
                handler = self.handlers.get(type(item))
                if handler is not None:
                    handler(item)
            self.batch_done()
            self._flush()

    def batch_done(self) -> None:
        """Called when all items that waited have been handled, before the scene is updated."""

    def options_changed(self, before: ViewOptions) -> None:
        """Called when the view options differ from ``before``, before the scene is updated."""

    def begin_map(self, hello: m.Hello) -> None:
        """Replace the map in the scene by an empty one."""
        if self.map is not None:
            self.map.clear()
        self.map = MapScene(self.server, hello)
        self.show_source(hello.source)

    def show_source(self, source: str) -> None:
        """Name the recording at the head of the panel."""
        self.server.gui.set_panel_label(f"taichi_mrf: {Path(source.partition('?')[0]).name}"[:60])

    def look_from(self, side: Side, client: int) -> None:
        """Show all that is seen of the map to one client, or else of its keyframes; or the opening view."""
        points = np.zeros((0, 3)) if self.map is None else self.map.seen_points()
        if not len(points) and (self.options.keyframes or self.options.path):
            points = self.keyframes.roster.path()[0].reshape(-1, 3)
        if len(points) or side == "home":
            self.viewpoint.look_from(client, side, points)

    def request(self, client: int, request: m.Request, asks: bool, *question: str) -> None:
        """Send a request; if it ``asks``, once its user has agreed to a question: title, text, yes, no."""
        handle = self.server.get_clients().get(client)
        if not asks:
            self.ask(request)
        elif handle is not None:
            self.panel.ask(handle, lambda: self.ask(request), *question)

    def notify(self, notice: m.Notice) -> None:
        """Show a notice in the list, and for some seconds in every browser."""
        self.panel.show_notice(notice)
        title = "Something went wrong" if notice.severity == "error" else "Note"
        text, color = notice.text[:_LONGEST_POP_UP], _POP_UP_COLORS[notice.severity]
        for client in self.server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=POP_UP_S, color=color)

    def show_counts(self) -> None:
        """Show how much of what the page shows, or will show in a moment."""
        if self.map is not None:
            self.panel.show_counts(self.map.counts(), self.map.ground.square_m, self.downloads.is_recording)

    def _announce(self) -> None:
        self.show_counts()
        self.server.flush()
        time.sleep(_HEAD_START_S)

    def _take_options(self) -> None:
        before, self.options = self.options, self.panel.view_options.value()
        if self.options == before:
            return
        self._pair_space_with_cut(before)
        if self.options.cut_axis != before.cut_axis:
            self._offer_cuts(in_middle=True)
            self.options = self.panel.view_options.value()
        self.options_changed(before)
        self.keyframes.show(self.options.keyframes, self.options.pictures, self.options.path)
        if self.map is not None:
            self.map.look_changed()

    def _pair_space_with_cut(self, before: ViewOptions) -> None:
        """Free space is seen in a cut only: make a level one for it unless there is a cut, and take that away
        with it; without a cut there is no free space to see."""
        options, handles = self.options, self.panel.view_options.handles
        if options.cut_axis != before.cut_axis:
            self._cut_for_space = False
            handles["free_space"].value &= options.cut_axis != "none"
        elif options.free_space and options.cut_axis == "none":
            handles["cut_axis"].value, self._cut_for_space = "xyz"[self.viewpoint.up[0]], True
        elif self._cut_for_space and not options.free_space:
            handles["cut_axis"].value, self._cut_for_space = "none", False
        self.options = self.panel.view_options.value()

    def _turn_colors(self, client: int) -> None:
        """The page's script takes dark colours as its user's wish for the others than now."""
        handle = self.server.get_clients().get(client)
        if handle is not None:
            handle.gui.configure_theme(control_width=self.control_width, dark_mode=True, **self._theme)

    def _offer_cuts(self, in_middle: bool = False) -> None:
        """Let the cut go from one end of the map to the other."""
        ends_m, axis = None if self.map is None else self.map.layers["map"].ends_m(), self.options.cut_axis
        along = None if ends_m is None or axis == "none" else ends_m[:, "xyz".index(axis)]
        if along is not None and self.viewpoint.up == ("xyz".index(axis), -1):  # heights
            along = -along[::-1]
        self.panel.show_cut(along, in_middle)

    def _flush(self) -> None:
        """Draw what has changed of the map, if it is time."""
        if self.map is None:
            return
        crossed = self.keyframes.roster.crossed()
        if not self.map.flush(self.options, self.viewpoint.up, crossed, self._announce):
            return
        self.show_counts()
        self._offer_cuts()
        self._show_used(self.map)
        if self.map.has_baseline != self._with_baseline:
            self._with_baseline = self.map.has_baseline
            self.viewpoint.look_beside(self._with_baseline)
        box = self.map.box_m()
        if box is not None:
            self.viewpoint.map_grew(*box, self.map.seen_points, self.map.voxels)
        in_cut = self.options.free_space and not self.map.has_baseline
        shown = self.map.scale, in_cut, self.map.shows_changes
        if shown != self._explained:
            self._explained = shown
            legend = "" if shown[0] is None else legend_html(shown[0])
            self.panel.show_legend(legend + key_html(*shown[1:]))

    def _show_used(self, shown: MapScene) -> None:
        """Show what belongs to the layers that are shown."""
        voxels, some = shown.shows_voxels, self.options.map or shown.has_baseline
        self.panel.show_used(
            draw_as=self.options.map and len(drawings_of(shown.hello)) > 1,
            color_by=some,
            threshold=voxels,
            size=voxels,
            shade=some,
            pictures=self.options.keyframes,
            changes=shown.hello.has_dates,
        )


def _backdrop() -> NDArray[np.uint8]:
    """The background of the scene, RGB, that of a run's pictures: neither white nor black things merge with
    it."""
    rows = np.linspace(_TOP, _BOTTOM, _BACKDROP_ROWS)
    return np.repeat(np.rint(rows).astype(np.uint8)[:, None], _BACKDROP_ROWS, axis=1)


def _latest(batch: list[Item]) -> list[Item]:
    """The batch without the items that a later one replaces."""
    kept: list[Item] = []
    seen: set[type] = set()
    for item in reversed(batch):
        if isinstance(item, _ONLY_THE_LATEST):
            if type(item) in seen:
                continue
            seen.add(type(item))
        kept.append(item)
    return kept[::-1]


NewPage = Callable[[viser.ViserServer, Callable[[m.Request], None]], BasePage[Any]]
"""Makes a page from the server and the function that sends a request to the mapping process."""


def run_viewer(connection: "Connection[Any, Any]", host: str, port: int, new_page: NewPage) -> None:
    """Serve a page until the mapping process sends Quit or ends.

    The first message back is Listening, or a Notice that says why there is no page.
    """
    # The mapping process gets these signals too, and tells this one when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pulse = Pulse(os.getppid())
    try:
        server = start_server(host, port, "taichi_mrf", pulse)
    except ViewerError as error:
        connection.send(m.Notice(str(error), "error"))
        return
    lock = threading.Lock()

    def ask(request: m.Request) -> None:
        with lock:
            try:
                connection.send(request)
            except OSError:
                page.inbox.put(None)

    page = new_page(server, ask)
    ask(m.Listening(server.get_host(), server.get_port()))
    threading.Thread(target=_read, args=(connection, page, pulse), daemon=True, name="reader").start()
    try:
        page.run()
    finally:
        server.stop()


def _read(connection: "Connection[Any, Any]", page: BasePage[Any], pulse: Pulse) -> None:
    """Put all updates into the page's inbox until the connection ends."""
    try:
        while True:
            pulse.heard()
            update = connection.recv()
            if isinstance(update, m.Quit):
                break
            if not isinstance(update, m.Alive):
                page.inbox.put(update)
    except (EOFError, OSError):
        pass
    page.inbox.put(None)
