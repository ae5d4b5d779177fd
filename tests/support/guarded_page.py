"""A guarded server with something of everything on its page, as fixtures for hostile clients."""

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from live_program import wait_for
from raw_viewer_client import RawClient, camera_message, raw_client, widget_message

from taichi_mrf.viewer.transport.server import start_server


class GuardedPage:
    """A server with one widget of each kind, a few nodes, and a list of the callbacks that came."""

    def __init__(self) -> None:
        self.server = start_server("127.0.0.1", 0, "Guarded")
        self.events: list[tuple[str, Any]] = []
        gui, scene = self.server.gui, self.server.scene
        self.widgets: dict[str, Any] = {
            "slider": gui.add_slider("s", min=0.1, max=1.0, step=0.1, initial_value=0.5),
            "whole slider": gui.add_slider("w", min=0, max=10, step=2, initial_value=4),
            "number": gui.add_number("n", initial_value=0.25, min=0.0, max=5.0, step=0.5),
            "whole number": gui.add_number("m", initial_value=3),
            "checkbox": gui.add_checkbox("c", initial_value=False),
            "text": gui.add_text("t", initial_value="text"),
            "dropdown": gui.add_dropdown("d", options=("a", "b"), initial_value="a"),
            "range": gui.add_multi_slider(
                "r", min=0.0, max=1.0, step=0.1, initial_value=(0.2, 0.8), min_range=0.1
            ),
            "rgb": gui.add_rgb("k", initial_value=(1, 2, 3)),
            "vector": gui.add_vector3("v", initial_value=(0.0, 0.0, 0.0), min=(-1.0, -1.0, -1.0), step=0.1),
            "button": gui.add_button("b"),
            "button group": gui.add_button_group("g", options=("x", "y")),
            "upload": gui.add_upload_button("u"),
            "progress": gui.add_progress_bar(10.0),
            "disabled": gui.add_checkbox("o", initial_value=False, disabled=True),
            "hidden": gui.add_checkbox("h", initial_value=False, visible=False),
        }
        with gui.add_folder("folder", visible=False), gui.add_tab_group().add_tab("tab"):
            self.widgets["in a hidden folder"] = gui.add_checkbox("i", initial_value=False)
        for name, widget in self.widgets.items():
            listen = getattr(widget, "on_update", None) or getattr(widget, "on_click", None)
            if listen is not None:
                listen(lambda event, name=name: self.events.append((name, event.target.value)))
        self.widgets["upload"].on_upload(lambda event: self.events.append(("upload", event.target.value)))
        self.mark = gui.add_slider("mark", min=0, max=10**6, step=1, initial_value=0)
        scene.add_point_cloud("/cloud", np.zeros((3, 3), np.float32), np.zeros(3, np.uint8))
        box = scene.add_box("/box")
        box.on_click(lambda event: self.events.append(("box", event.ray_direction)))
        scene.on_click()(lambda event: self.events.append(("scene", event.ray_direction)))
        self.gizmo = scene.add_transform_controls("/gizmo")
        self.gizmo.on_update(lambda event: self.events.append(("gizmo", event.phase)))
        self.hidden_gizmo = scene.add_transform_controls("/hidden", visible=False)
        self._first_values = {name: widget.value for name, widget in self.widgets.items()}

    def reset(self) -> None:
        """Put every widget back, and forget what happened."""
        for name, widget in self.widgets.items():
            if not widget._impl.is_button:
                widget.value = self._first_values[name]
        self.events.clear()

    def uuid(self, name: str) -> str:
        return self.widgets[name]._impl.uuid

    def state(self) -> dict[str, Any]:
        """All that a client could try to change."""
        state = {name: widget.value for name, widget in self.widgets.items()}
        for gizmo in (self.gizmo, self.hidden_gizmo):
            state[gizmo.name] = (tuple(gizmo.wxyz), tuple(gizmo.position))
        return state

    def settle(self, stranger: RawClient) -> None:
        """Wait until everything that ``stranger`` has said is dealt with, and its callbacks have run."""
        wanted = self.mark.value + 1

        def marked() -> bool:
            stranger.say(widget_message(self.mark._impl.uuid, wanted))
            return self.mark.value == wanted

        wait_for(marked, "the mark")
        self.server._thread_executor.submit(lambda: None).result()


@pytest.fixture(scope="session")
def running_page() -> Iterator[GuardedPage]:
    """One page for all tests: what they do to it must not matter."""
    page = GuardedPage()
    yield page
    page.server.stop()


@pytest.fixture
def guarded(
    running_page: GuardedPage, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> Iterator[GuardedPage]:
    """A page in its first state, on which nothing may go wrong and which a new client must find well."""
    running_page.reset()
    yield running_page
    with raw_client(running_page.server.get_port()) as friend:
        friend.say(camera_message())
        running_page.settle(friend)
        friend.hear_type("PointCloudMessage", name="/cloud")
    assert capfd.readouterr() == ("", "")
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.fixture
def stranger(guarded: GuardedPage) -> Iterator[RawClient]:
    """A client that viser has accepted and that has the whole page."""
    with raw_client(guarded.server.get_port()) as connected:
        connected.say(camera_message())
        guarded.settle(connected)
        connected.hear_type("ReplayDoneMessage")
        yield connected
