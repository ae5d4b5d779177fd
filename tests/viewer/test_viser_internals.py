"""The guard's knowledge of viser's internals still holds; each failure says what to mend, and where."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import viser

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.transport import viser_internals as internals

if TYPE_CHECKING:
    from guarded_page import GuardedPage
    from raw_viewer_client import RawClient

pytest_plugins = ["guarded_page"]

WIDGET: dict[str, type] = {
    "_impl.gui_api": viser.GuiApi,
    "_impl.parent_container_id": str,
    "_impl.is_button": bool,
    "_impl.uuid": str,
    "_impl.props": object,
}
"""Attributes that are read of a widget."""

CLIENT: dict[str, type] = {"_websock_connection._incoming_handlers": dict}
"""Attributes that are read of a client."""

TAB: dict[str, type] = {"_parent": viser.GuiTabGroupHandle}
"""Attributes that are read of a tab."""

MEND = f"viser {viser.__version__} is not what the guard was written for; mend {{}}: {{}}"


def must_be_empty(changes: list[str], file: str = internals.HERE) -> None:
    assert not changes, MEND.format(file, "; ".join(changes))


def test_a_server_has_what_the_guard_reads(guarded: GuardedPage) -> None:
    must_be_empty(internals.changes_in(guarded.server, internals.SERVER))


def test_widgets_have_what_the_guard_reads(guarded: GuardedPage) -> None:
    for widget in guarded.widgets.values():
        must_be_empty(internals.changes_in(widget, WIDGET))
        assert internals.is_button(widget) == ("Button" in type(widget).__name__)


def test_a_client_and_a_tab_have_what_the_guard_reads(guarded: GuardedPage, stranger: RawClient) -> None:
    for client in guarded.server.get_clients().values():
        must_be_empty(internals.changes_in(client, CLIENT))
    hidden = guarded.widgets["in a hidden folder"]
    tab = hidden._impl.gui_api._resolve_container_handle(hidden._impl.parent_container_id)
    must_be_empty(internals.changes_in(tab, TAB))


def test_all_scripts_of_the_page_get_the_nonce() -> None:
    page = internals.PAGE.read_text("utf-8")
    assert internals.with_nonce(page, "N").count('nonce="N"') == page.count("<script") + 1
    with pytest.raises(ViewerError, match="packed in another way"):
        internals.with_nonce("<script></script>", "N")


def test_a_change_is_said_with_the_attribute() -> None:
    changes = internals.changes_in(viser, {"ViserServer.nothing": int, "__name__": int})
    assert changes == ["module has no ViserServer.nothing", "module.__name__ is of the type str, not int"]
