"""A client's websocket behind the gate.

viser asks a connection for its next message; this one answers with the next message that may pass. What a
client may send is bounded in size before it is parsed, and in number.
"""

import asyncio
from dataclasses import dataclass
from time import monotonic
from typing import Any

from viser import _messages as theirs
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.protocol import State

from taichi_mrf.viewer.transport.client_messages import Undecodable, encode
from taichi_mrf.viewer.transport.client_messages import decode as decode_message
from taichi_mrf.viewer.transport.guard import Gate

MESSAGES_PER_SECOND = 200.0
"""The rate at which one client may send for long; the stock client stays below 100."""

LARGEST_MESSAGE = 64 * 1024
"""Bytes of any message but a picture that was asked for."""

LARGEST_PICTURE = 18 * 2**20
"""Bytes; downloads.MOST_PIXELS without compression take less."""

CAMERA_INTERVAL_S = 0.02
"""Cameras that come faster replace each other."""

TYPING_REST_S = 1.0
"""Seconds without another key after which a number that may be unfinished is taken. The browser sends a
message for every key: 0 before 0.8, and 1 and 1.2 before 1.25."""

CLOSE_TIMEOUT_S = 0.5
"""How long a client may take to answer a close frame."""


@dataclass
class Budget:
    """A bucket of ``rate`` tokens that fills in one second; ``filled_at`` is when it was looked at last."""

    rate: float
    tokens: float
    filled_at: float

    def spend(self, now: float) -> bool:
        """Take a token if there is one; ``now`` in seconds of the same clock."""
        self.tokens = min(self.rate, self.tokens + (now - self.filled_at) * self.rate)
        self.filled_at = now
        if self.tokens < 1.0:
            return False
        self.tokens -= 1.0
        return True


class GuardedConnection(ServerConnection):
    """A websocket that gives only what ``gate`` admits, and cameras at a steady pace.

    The server sets the gate when it opens; without one the connection gives nothing.
    """

    gate: Gate | None = None

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._budget = Budget(MESSAGES_PER_SECOND, MESSAGES_PER_SECOND, monotonic())
        self._reading: asyncio.Task[str | bytes] | None = None
        self._held: dict[str, tuple[float, theirs.Message]] = {}
        """Messages that are admitted later unless others replace them, with the time when they are due."""
        self._camera_due = 0.0
        self._picture_bytes = 0
        """Bytes that have come since a picture was asked for."""

    def data_received(self, data: bytes) -> None:
        """Take in bytes; a client whose next message is already too large loses its connection."""
        super().data_received(data)
        if self.protocol.state is State.OPEN and not self._is_within_size(len(data)):
            self.protocol.fail(CloseCode.MESSAGE_TOO_BIG, "the message is too large")
            self.send_data()

    async def recv(self, decode: bool | None = None) -> bytes:  # type: ignore[override]
        """The next message that may pass.

        Raises websockets' ConnectionClosed, also after this side has closed because the client cannot be a
        viewer's page.
        """
        while True:
            message = self._due_message()
            if message is None:
                received = await self._receive(self._patience_s())
                message = None if received is None else await self._understand(received)
            client_id = None if self.gate is None else self.gate.client_id(self)
            if message is not None and self.gate is not None and client_id is not None:
                admitted = self.gate.admit(client_id, message)
                if admitted is not None:
                    return encode(admitted)

    async def close(self, code: CloseCode | int = CloseCode.NORMAL_CLOSURE, reason: str = "") -> None:
        """Close, or cut off a client that reads nothing: a full buffer keeps back even the close frame."""
        cut_off = self.loop.call_later(2 * CLOSE_TIMEOUT_S, self.transport.abort)
        try:
            await super().close(code, reason)
        finally:
            cut_off.cancel()

    def _is_within_size(self, received: int) -> bool:
        """True if the message that is arriving has not outgrown its bound, with the ``received`` bytes of it
        or of those before it. While a picture is awaited, all that comes may be as large as one."""
        client_id = None if self.gate is None else self.gate.client_id(self)
        if self.gate is not None and client_id is not None and self.gate.awaits_picture(client_id):
            self._picture_bytes += received
            return self._picture_bytes <= LARGEST_PICTURE
        self._picture_bytes = 0
        return len(self.protocol.reader.buffer) + (self.protocol.current_size or 0) <= LARGEST_MESSAGE

    def _due_message(self) -> theirs.Message | None:
        """A message that was held back and whose time has come."""
        now = monotonic()
        for key, (due, message) in self._held.items():
            if due <= now:
                del self._held[key]
                if isinstance(message, theirs.ViewerCameraMessage):
                    self._camera_due = now + CAMERA_INTERVAL_S
                return message
        return None

    def _typed_is_complete(self) -> bool:
        """Release what is being typed, because the user now uses another widget; returns whether there was
        anything."""
        typed = {key: message for key, (_, message) in self._held.items() if key != "camera"}
        self._held |= {key: (monotonic(), message) for key, message in typed.items()}
        return bool(typed)

    def _patience_s(self) -> float | None:
        """Seconds until a message that is held back is due; None if there is none."""
        if not self._held:
            return None
        return max(0.0, min(due for due, _ in self._held.values()) - monotonic())

    async def _receive(self, timeout_s: float | None) -> str | bytes | None:
        """The next message as it arrived; None if none arrives in time."""
        if self._reading is None:
            self._reading = asyncio.create_task(super().recv())
        try:
            await asyncio.wait({self._reading}, timeout=timeout_s)
        except asyncio.CancelledError:
            self._reading.cancel()
            raise
        if not self._reading.done():
            return None
        reading, self._reading = self._reading, None
        return reading.result()

    async def _understand(self, received: str | bytes) -> theirs.Message | None:
        """The message, unless it is refused or held back. Closes the connection if viser's client cannot
        have sent it."""
        if isinstance(received, str):
            await self.close(CloseCode.UNSUPPORTED_DATA)
            return None
        client_id = None if self.gate is None else self.gate.client_id(self)
        if self.gate is None or client_id is None:
            return None
        is_large = len(received) > LARGEST_MESSAGE
        if is_large and not self.gate.awaits_picture(client_id):
            await self.close(CloseCode.MESSAGE_TOO_BIG)
            return None
        try:
            message = decode_message(received)
        except Undecodable:
            await self.close(CloseCode.INVALID_DATA)
            return None
        if message is None or (is_large and not isinstance(message, theirs.GetRenderResponseMessage)):
            return None
        if isinstance(message, theirs.ViewerCameraMessage):  # costs nothing: only one of them waits
            if self.gate.admit(client_id, message) is not None:
                self._held["camera"] = self._camera_due, message
            return None
        if not self._budget.spend(monotonic()):
            return None
        if isinstance(message, theirs.GuiUpdateMessage):
            self._held.pop(message.uuid, None)
            if self.gate.may_be_unfinished(client_id, message):
                self._held[message.uuid] = monotonic() + TYPING_REST_S, message
                return None
            if self._typed_is_complete():
                self._held[message.uuid] = monotonic(), message  # after what was typed
                return None
        return message
