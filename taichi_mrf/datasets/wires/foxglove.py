"""Foxglove's WebSocket protocol, as ``foxglove_bridge`` on a robot speaks it: the client's side.

The server says in text frames of JSON which channels there are (``advertise``, ``unadvertise``); the client
asks for those it wants (``subscribe``). A message is a binary frame: the byte 1, the number of the
subscription (uint32), the time at which the server logged it (uint64, nanoseconds), all in little endian, and
the message as ROS encodes it (https://github.com/foxglove/ws-protocol).

A thread receives. A connection that is lost is made again, with the same topics.
"""

import json
import socket
import struct
import threading
from collections.abc import Collection
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from taichi_mrf.datasets.ros.decoding import CDR, LANGUAGES, ROS1, ros2_name
from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.datasets.wires.client import Client
from taichi_mrf.datasets.wires.schemas import JSON, PROTOBUF, ROS_TYPES
from taichi_mrf.errors import DatasetError, said

SUBPROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]
PORT = 8765
BRIDGE = "ros2 launch foxglove_bridge foxglove_bridge_launch.xml"

LARGEST = 1 << 28
"""Bytes of a frame at most."""

CONNECT_S = 5.0
RETRY_S = 1.0

_MESSAGE = struct.Struct("<BIQ")
_MESSAGE_DATA = 1


class FoxgloveClient(Client):
    """A connection to a server."""

    def __init__(self, address: str) -> None:
        """Connect to ``ws://host:port``; the scheme and the port may be missing. Raises DatasetError, which
        names the address, if nobody listens there or another program does."""
        whole = _whole(address)
        super().__init__(whole, f"foxglove:{whole}")
        self._wanted: set[str] = set()
        self._subscribed: set[int] = set()  # a channel's number serves for its subscription, too
        self._by_number: dict[int, Channel] = {}
        self._advertised, self._ended = threading.Event(), threading.Event()
        self._connection = self._connect()
        self._thread = threading.Thread(target=self._receive, name="foxglove", daemon=True)
        self._thread.start()
        if not self._advertised.wait(CONNECT_S):
            self.close()
            raise DatasetError(
                f"{self.address}: a Foxglove server without topics: nothing is published there, or its "
                "topic_whitelist leaves out all"
            )

    def subscribe(self, topics: Collection[str]) -> None:
        self._wanted = set(topics)
        self._ask()

    def close(self) -> None:
        self._ended.set()
        self._connection.close()

    def _connect(self) -> ClientConnection:
        where = f"{self.address}:"
        try:
            connection = connect(
                self.address,
                subprotocols=SUBPROTOCOLS,
                open_timeout=CONNECT_S,
                close_timeout=1.0,
                max_size=LARGEST,
                compression=None,
            )
        except ConnectionRefusedError as error:
            raise DatasetError(f"{where} nobody listens there: start '{BRIDGE}' on the robot") from error
        except TimeoutError as error:
            raise DatasetError(
                f"{where} no answer within {CONNECT_S:g} s: is the robot on, in this network, its port open?"
            ) from error
        except socket.gaierror as error:
            host = urlsplit(self.address).hostname
            raise DatasetError(f"{where} no machine is called {host}: try its IP address") from error
        except (InvalidHandshake, EOFError) as error:
            raise DatasetError(f"{where} {_another(said(error))}") from error
        except (OSError, InvalidURI, ValueError) as error:
            raise DatasetError(f"{where} cannot be reached: {said(error)}") from error
        if connection.subprotocol is None:
            connection.close()
            raise DatasetError(f"{where} {_another('it does not speak foxglove.sdk.v1')}")
        return connection

    def _receive(self) -> None:
        while not self._ended.is_set():
            try:
                for frame in self._connection:
                    self._take_in(frame)
                why = "the server has closed the connection"
            except ConnectionClosed as error:
                why = said(error)
            except Exception as error:  # whatever a damaged frame leads to
                why = f"a frame cannot be read: {said(error)}"
            if not self._ended.is_set():
                self._connect_again(f"the connection is lost ({why})")

    def _connect_again(self, why: str) -> None:
        self.problem = f"{self.address}: {why}; trying again"
        self._connection.close()
        with self._lock:
            self._subscribed.clear()
            self._by_number.clear()
            self.channels = {}
        while not self._ended.wait(RETRY_S):
            try:
                self._connection = self._connect()
            except DatasetError as error:
                self.problem = f"{error}; trying again"
                continue
            self.problem = ""
            if self._ended.is_set():  # closed while it was made
                self._connection.close()
            return

    def _take_in(self, frame: str | bytes) -> None:
        if isinstance(frame, str):
            self._take_in_words(json.loads(frame))
            return
        if len(frame) < _MESSAGE.size or frame[0] != _MESSAGE_DATA:
            return  # the server's time, or an answer that was not asked for
        _, number, logged_ns = _MESSAGE.unpack_from(frame)
        with self._lock:
            if number in self._subscribed:
                self._keep(self._by_number[number], logged_ns, frame[_MESSAGE.size :])

    def _take_in_words(self, words: dict[str, Any]) -> None:
        with self._lock:
            if words.get("op") == "advertise":
                self._by_number |= {each["id"]: _channel(each) for each in words["channels"]}
            elif words.get("op") == "unadvertise":
                for number in words["channelIds"]:
                    self._by_number.pop(number, None)
                    self._subscribed.discard(number)
            else:
                return
            self.channels = {each.topic: each for each in self._by_number.values()}
        if self.channels:
            self._advertised.set()
        self._ask()

    def _ask(self) -> None:
        """Subscribe to the wanted channels that are there, and to no others."""
        with self._lock:
            numbers = {each.topic: number for number, each in self._by_number.items()}
            wanted = {number for topic, number in numbers.items() if topic in self._wanted}
            new, gone = sorted(wanted - self._subscribed), sorted(self._subscribed - wanted)
            self._subscribed = wanted
        if gone:
            self._send({"op": "unsubscribe", "subscriptionIds": gone})
        if new:
            pairs = [{"id": number, "channelId": number} for number in new]
            self._send({"op": "subscribe", "subscriptions": pairs})

    def _send(self, words: dict[str, Any]) -> None:
        with suppress(ConnectionClosed):  # the thread connects again, and subscribes
            self._connection.send(json.dumps(words))


def _channel(words: dict[str, Any]) -> Channel:
    """A channel as it is advertised. Of those in protobuf or JSON Foxglove's own types are read."""
    topic, encoding, kind = str(words["topic"]), str(words["encoding"]), str(words.get("schemaName", ""))
    definition = str(words.get("schema", ""))
    if encoding in (PROTOBUF, JSON) and kind in ROS_TYPES:
        return Channel(topic, ROS_TYPES[kind], encoding, "NONE", definition, kind)
    language = str(words.get("schemaEncoding", "")) or {CDR: "ros2msg", ROS1: "ros1msg"}.get(encoding, "")
    type = ros2_name(kind) if encoding == ROS1 else kind
    return Channel(topic, type, encoding, LANGUAGES.get(language, "NONE"), definition)


def _another(why: str) -> str:
    return (
        f"another program listens there, not a Foxglove server ({why}): '{BRIDGE}' starts one, "
        f"on port {PORT} (rosbridge, on 9090, speaks another protocol)"
    )


def _whole(address: str) -> str:
    """An address with its scheme and port. Raises DatasetError if it is none."""
    text = address or "localhost"
    text = text if "://" in text else f"ws://{text}"
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise DatasetError(f"foxglove:{address}: {said(error)}; an address is ws://HOST:{PORT}") from error
    if parts.scheme not in ("ws", "wss") or not host:
        raise DatasetError(f"foxglove:{address}: is not a server address: write ws://HOST:{PORT}")
    return text if port else f"{parts.scheme}://{parts.netloc.rstrip(':')}:{PORT}{parts.path}"
