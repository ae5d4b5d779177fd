"""Files that a browser gets from the page: pictures, standalone pages, recordings."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import viser

_PICTURE_TIMEOUT_S = 20.0
_MOST_PIXELS = 2560


class Downloads:
    """Makes files beside the page's owner, which must not wait for a browser or a compressor."""

    def __init__(self, server: viser.ViserServer, problem: Callable[[str], None]) -> None:
        self._server, self._problem = server, problem
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="downloads")
        self._recording: Any = None
        self._recorded_to = 0.0

    @property
    def is_recording(self) -> bool:
        """Whether the scene is being recorded."""
        return self._recording is not None

    def send(self, client: int, name: str, content: bytes) -> None:
        """Give a browser a file; nothing happens if it has left."""
        handle = self._server.get_clients().get(client)
        if handle is not None:
            handle.send_file_download(name, content, save_immediately=True)

    def picture(self, client: int) -> None:
        """What that browser shows, as PNG."""
        self._later("picture", lambda: self._picture(client))

    def page(self, client: int, dark: bool) -> None:
        """The scene as one HTML file."""
        scene = self._server.get_scene_serializer()
        self._later("page", lambda: self.send(client, "map.html", scene.as_html(dark).encode()))

    def toggle_recording(self, client: int) -> None:
        """Begin to record, or end it and give the browser the file."""
        if self._recording is None:
            self._recording, self._recorded_to = self._server.get_scene_serializer(), time.monotonic()
            return
        self.tick()
        recording, self._recording = self._recording, None
        self._later("recording", lambda: self.send(client, "map.viser", recording.serialize()))

    def tick(self) -> None:
        """Tell the recording how much time has gone by; call it before each change of the scene."""
        if self._recording is not None:
            now = time.monotonic()
            self._recording.insert_sleep(now - self._recorded_to)
            self._recorded_to = now

    def _picture(self, client: int) -> None:
        handle = self._server.get_clients().get(client)
        if handle is None:
            return
        height, width = handle.camera.image_height, handle.camera.image_width
        shrink = max(1.0, max(height, width) / _MOST_PIXELS)
        rendered = handle.get_render(
            int(height / shrink), int(width / shrink), transport_format="png", timeout=_PICTURE_TIMEOUT_S
        )
        bgra = rendered[..., [2, 1, 0, 3]] if rendered.shape[2] == 4 else rendered[..., ::-1]
        self.send(client, "view.png", cv2.imencode(".png", np.ascontiguousarray(bgra))[1].tobytes())

    def _later(self, what: str, work: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                work()
            except Exception as error:  # a browser that leaves or hangs is its own affair
                self._problem(f"The {what} could not be made: {error or type(error).__name__}")

        self._pool.submit(guarded)
