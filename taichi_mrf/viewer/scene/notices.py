"""Notices for the user: the list on a tab of the page, and the ones that pop up over the page."""

from collections.abc import Iterable
from typing import Literal

import viser

from taichi_mrf.viewer.messages import Notice
from taichi_mrf.viewer.scene.safe_text import in_html

_COLORS = {"info": "inherit", "warning": "#c77700", "error": "#c62828"}
_POP_UP_COLORS: dict[str, Literal["blue", "yellow", "red"]] = {
    "info": "blue",
    "warning": "yellow",
    "error": "red",
}
_POP_UP_S = 8.0
_LONGEST_POP_UP = 500


def notices_html(notices: Iterable[Notice]) -> str:
    """A paragraph for each notice, in the order given and the colour of its severity."""
    lines = "".join(
        f'<p style="margin:0.2em 0;color:{_COLORS[each.severity]}">{in_html(each.text)}</p>'
        for each in notices
    )
    return f'<div style="margin:0.5em 0.75em;font-size:0.85em">{lines}</div>'


def pop_up(server: viser.ViserServer, notice: Notice) -> None:
    """Show a notice for some seconds in every browser."""
    title = "Something went wrong" if notice.severity == "error" else "Note"
    color = _POP_UP_COLORS[notice.severity]
    text = notice.text[:_LONGEST_POP_UP]
    for client in server.get_clients().values():
        client.add_notification(title, text, auto_close_seconds=_POP_UP_S, color=color)
