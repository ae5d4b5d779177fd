"""A scene as one HTML file that needs no server, with a content security policy of its own."""

import base64
import hashlib
import re

from viser.infra import StateSerializer

from taichi_mrf.errors import ViewerError
from taichi_mrf.viewer.transport.viser_internals import HERE, page_script_hashes

POLICY = (
    "default-src 'none'; script-src 'wasm-unsafe-eval' {scripts}; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)
"""The file runs only viser's scripts, even if the scene holds text with scripts in it, and loads nothing from
a network."""


def standalone_page(scene: StateSerializer, dark: bool) -> str:
    """The HTML of a scene. Raises ViewerError if viser's page is not built as this package knows it."""
    html = scene.as_html(dark)
    begin, end = html.find("<script>window.__VISER_EMBED_DATA__="), html.find("</script></head>")
    head = re.search(r"<head[^>]*>", html[: max(begin, 0)])
    if head is None or begin > end:
        raise ViewerError(f"cannot protect viser's standalone page: it has changed; mend {HERE}")
    data = html[begin + len("<script>") : end].encode()
    digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
    policy = POLICY.format(scripts=" ".join([*page_script_hashes(), f"'sha256-{digest}'"]))
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    return html[: head.end()] + meta + html[head.end() :]
