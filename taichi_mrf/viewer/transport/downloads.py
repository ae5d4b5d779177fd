"""Files that a browser gets from the page: pictures, standalone pages, recordings."""

import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import viser
from viser.infra import StateSerializer

from taichi_mrf.viewer.transport.origin import POLICY
from taichi_mrf.viewer.transport.viser_internals import with_nonce

PICTURE_TIMEOUT_S = 30.0
"""How long a browser may take to draw and send a picture."""

PICTURES_AT_ONCE = 8
"""Of as many browsers pictures are awaited at the same time, one of each."""

MOST_PIXELS = 2560 * 1600
"""Of a picture; larger windows are scaled down."""


class Downloads:
    """Makes files on threads of their own: the page's thread must not wait for a browser or for
    compression."""

    def __init__(self, server: viser.ViserServer, problem: Callable[[str], None]) -> None:
        """``problem`` takes a sentence that says what failed, on any thread."""
        self._server, self._problem = server, problem
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="downloads")
        self._lock = threading.Lock()
        self._begun: set[tuple[int, str]] = set()
        """Clients and the kinds of files that are being made for them: one of each kind at a time."""
        self._recording: Any = None
        self._recorded_to = 0.0

    @property
    def is_recording(self) -> bool:
        """True if the scene is being recorded."""
        return self._recording is not None

    def send(self, client: int, name: str, content: bytes) -> None:
        """Give a browser a file; nothing happens if it has left."""
        handle = self._server.get_clients().get(client)
        if handle is not None:
            handle.send_file_download(name, content, save_immediately=True)

    def picture(self, client: int) -> None:
        """Give a browser what it shows, as PNG. A browser that does not answer delays no other
        download."""
        with self._lock:
            is_full = sum(kind == "picture" for _, kind in self._begun) >= PICTURES_AT_ONCE
        if is_full and (client, "picture") not in self._begun:
            self._problem(f"{PICTURES_AT_ONCE} pictures are being made; try again in a moment")
        elif self._begin(client, "picture"):
            work = (client, "picture", lambda: self._picture(client))
            threading.Thread(target=self._finish, args=work, name="picture", daemon=True).start()

    def page(self, client: int) -> None:
        """Give a browser the scene as one HTML file."""
        if self._begin(client, "page"):
            scene = self._server.get_scene_serializer()
            self._later(
                client, "page", lambda: self.send(client, "map.html", standalone_page(scene).encode())
            )

    def toggle_recording(self, client: int) -> None:
        """Start to record, or stop and give the browser the file."""
        if self._recording is None:
            self._recording, self._recorded_to = self._server.get_scene_serializer(), time.monotonic()
            return
        self.tick()
        recording, self._recording = self._recording, None
        self._begin(client, "recording")
        self._later(client, "recording", lambda: self.send(client, "map.viser", recording.serialize()))

    def tick(self) -> None:
        """Tell the recording how much time has passed; call it before each change of the scene."""
        if self._recording is not None:
            now = time.monotonic()
            self._recording.insert_sleep(now - self._recorded_to)
            self._recorded_to = now

    def _picture(self, client: int) -> None:
        handle = self._server.get_clients().get(client)
        if handle is None:
            return
        height, width = handle.camera.image_height, handle.camera.image_width
        shrink = max(1.0, (height * width / MOST_PIXELS) ** 0.5)
        rendered = handle.get_render(
            max(1, int(height / shrink)),
            max(1, int(width / shrink)),
            transport_format="png",
            timeout=PICTURE_TIMEOUT_S,
        )
        bgra = rendered[..., [2, 1, 0, 3]] if rendered.shape[2] == 4 else rendered[..., ::-1]
        self.send(client, "view.png", cv2.imencode(".png", np.ascontiguousarray(bgra))[1].tobytes())

    def _begin(self, client: int, kind: str) -> bool:
        """True if no file of this kind is being made for this client yet; from now on one is."""
        with self._lock:
            is_new = (client, kind) not in self._begun
            self._begun.add((client, kind))
        return is_new

    def _later(self, client: int, kind: str, work: Callable[[], None]) -> None:
        self._pool.submit(self._finish, client, kind, work)

    def _finish(self, client: int, kind: str, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # a browser that leaves or hangs must not end the page
            self._problem(f"The {kind} could not be made: {error or type(error).__name__}")
        finally:
            with self._lock:
                self._begun.discard((client, kind))


def standalone_page(scene: StateSerializer) -> str:
    """The HTML of a scene. It runs only viser's scripts, even if the scene holds text with scripts in it, and
    loads nothing from a network. Raises ViewerError if viser's page is not built as this package knows it."""
    nonce = secrets.token_urlsafe(16)
    policy = POLICY.format(nonce=nonce, server="")
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    return with_nonce(scene.as_html(), nonce).replace("<head>", f"<head>{meta}", 1)
