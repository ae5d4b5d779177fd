"""What the user should know, as the list that every page shows of it."""

import html
from collections.abc import Iterable

from taichi_mrf.viewer.messages import Notice

_COLORS = {"info": "inherit", "warning": "#c77700", "error": "#c62828"}


def notices_html(notices: Iterable[Notice]) -> str:
    """A paragraph for each notice, in the order given and the colour of its severity."""
    lines = "".join(
        f'<p style="margin:0.2em 0;color:{_COLORS[each.severity]}">{html.escape(each.text)}</p>'
        for each in notices
    )
    return f'<div style="margin:0.5em 0.75em;font-size:0.85em">{lines}</div>'
