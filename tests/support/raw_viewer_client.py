"""A bare websocket client of the viewer: says what it likes, in the stock client's encoding."""

import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import viser
import zstandard
from live_program import DEADLINE_S
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect


class RawClient:
    """One connection; ``say`` takes a message as a map, or any bytes or text."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self._heard: deque[dict[str, Any]] = deque()

    def say(self, message: dict[str, Any] | bytes | str | list[bytes]) -> None:
        """A list is sent as the fragments of one message."""
        self.connection.send(msgspec.msgpack.encode(message) if isinstance(message, dict) else message)

    def end_after(self, *messages: dict[str, Any] | bytes | str | list[bytes]) -> int | None:
        """The code with which the server closes the connection after these messages; None if its close frame
        was lost behind what was still being sent. Raises TimeoutError if it stays open."""
        try:
            for message in messages:
                self.say(message)
            self.hear_type("never")
        except ConnectionClosed as closed:
            return None if closed.rcvd is None else closed.rcvd.code
        raise AssertionError("unreachable: nothing has the type 'never'")

    def hear(self, matches: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next message for which ``matches`` holds, with what comes before it thrown away."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            while self._heard:
                message = self._heard.popleft()
                if matches(message):
                    return message
            frame = self.connection.recv(timeout=max(deadline - time.monotonic(), 0.0))
            self._heard.extend(decode_frame(frame))

    def hear_type(self, kind: str, **fields: Any) -> dict[str, Any]:
        """The next message of this kind that has these values in these fields."""
        wanted = {"type": kind, **fields}
        return self.hear(lambda message: wanted.items() <= message.items())


def decode_frame(frame: bytes | str) -> list[dict[str, Any]]:
    """The messages of one frame from viser: 8 bytes, length of the compressed map, the map, arrays."""
    assert isinstance(frame, bytes)
    length = int.from_bytes(frame[8:16], "little")
    return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + length]))[
        "messages"
    ]


@contextmanager
def raw_client(
    port: int, *, origin: str | None = None, host: str | None = None, version: str = viser.__version__
) -> Iterator[RawClient]:
    """A connection to 127.0.0.1 whose Host header says ``host``; an own page's Origin unless given."""
    host = host or f"127.0.0.1:{port}"
    origin = origin or f"http://{host}"
    with connect(
        f"ws://{host}/",
        sock=socket.create_connection(("127.0.0.1", port)),
        additional_headers={} if origin == "none" else {"Origin": origin},
        subprotocols=[f"viser-v{version}"],  # type: ignore[list-item]
        compression=None,
        max_size=None,  # as in a browser
    ) as connection:
        yield RawClient(connection)


def camera_message(**changes: Any) -> dict[str, Any]:
    """First message of the stock client, about an eye three metres away."""
    return {
        "type": "ViewerCameraMessage",
        "wxyz": [1.0, 0.0, 0.0, 0.0],
        "position": [3, 0.5, 0],
        "image_height": 600,
        "image_width": 800,
        "fov": 1.2,
        "near": 0.01,
        "far": 1000,
        "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0, 0, 1],
        **changes,
    }


def widget_message(uuid: str, value: Any) -> dict[str, Any]:
    """A widget was used."""
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
