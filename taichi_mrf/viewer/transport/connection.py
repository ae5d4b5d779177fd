"""A client's websocket, heard through the gate.

viser asks a connection for its next message; this one answers with the next message that may pass.
"""

import asyncio
from dataclasses import dataclass
from time import monotonic
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode

from taichi_mrf.viewer.transport.client_messages import AnyClientMessage, Camera, Picture, Undecodable, encode
from taichi_mrf.viewer.transport.client_messages import decode as decode_message
from taichi_mrf.viewer.transport.guard import Gate

MESSAGES_PER_SECOND = 200.0
"""What one client may say for long; the stock client stays below 100."""

LARGEST_MESSAGE = 64 * 1024
"""Bytes of anything but a picture that was asked for."""

CAMERA_INTERVAL_S = 0.02
"""Cameras that come faster replace each other."""

CLOSE_TIMEOUT_S = 0.5
"""How long a client may take to answer a goodbye."""


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

    Whoever opens the door to a connection sets its gate; without one it gives nothing.
    """

    gate: Gate

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._budget = Budget(MESSAGES_PER_SECOND, MESSAGES_PER_SECOND, monotonic())
        self._reading: asyncio.Task[str | bytes] | None = None
        self._camera: Camera | None = None
        self._camera_due = 0.0

    async def recv(self, decode: bool | None = None) -> bytes:  # type: ignore[override]
        """The next message that may pass.

        Raises websockets' ConnectionClosed, also after this side has closed because what came cannot be
        from a viewer's page.
        """
        while True:
            now = monotonic()
            if self._camera is not None and now >= self._camera_due:
                camera, self._camera = self._camera, None
                self._camera_due = now + CAMERA_INTERVAL_S
                return encode(camera)
            heard = await self._hear(None if self._camera is None else self._camera_due - now)
            message = None if heard is None else await self._understand(heard)
            if isinstance(message, Camera):
                self._camera = message
            elif message is not None:
                return encode(message)

    async def close(self, code: CloseCode | int = CloseCode.NORMAL_CLOSURE, reason: str = "") -> None:
        """Close, or cut off a client that takes nothing in: a full buffer keeps back even the goodbye."""
        cut_off = self.loop.call_later(2 * CLOSE_TIMEOUT_S, self.transport.abort)
        try:
            await super().close(code, reason)
        finally:
            cut_off.cancel()

    async def _hear(self, timeout_s: float | None) -> str | bytes | None:
        """The next message as it came; None if there is none in time."""
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

    async def _understand(self, heard: str | bytes) -> AnyClientMessage | None:
        """What the gate makes of it. Closes the connection where it is not viser's language at all."""
        client_id = self.gate.client_id(self)
        if isinstance(heard, str):
            await self.close(CloseCode.UNSUPPORTED_DATA)
        elif client_id is not None and (len(heard) <= LARGEST_MESSAGE or self.gate.awaits_picture(client_id)):
            try:
                message = decode_message(heard)
            except Undecodable:
                await self.close(CloseCode.INVALID_DATA)
                return None
            too_large = len(heard) > LARGEST_MESSAGE and not isinstance(message, Picture)
            if message is not None and not too_large and self._can_afford(message):
                return self.gate.admit(client_id, message)
        return None

    def _can_afford(self, message: AnyClientMessage) -> bool:
        """Cameras cost nothing: there is never more than one of them waiting."""
        return isinstance(message, Camera) or self._budget.spend(monotonic())
