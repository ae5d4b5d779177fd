"""Raw messages of ROS 1 and ROS 2 as objects with fields, by the definitions that their channels bring.

The library ``rosbags`` decodes them; its errors are of many kinds. A channel of another encoding, or whose
definition cannot be parsed, is set aside with the reason, where the library would refuse all of them.
"""

import importlib
from collections.abc import Sequence
from typing import Any

from taichi_mrf.datasets.ros.sources import Channel
from taichi_mrf.errors import said

ROS1, CDR = "ros1", "cdr"
LANGUAGES = {"ros2msg": "MSG", "ros1msg": "MSG", "ros2idl": "IDL", "omgidl": "IDL"}
"""The languages of definitions, by the names of their encodings in MCAP files and on Foxglove's wire."""

_IDL_RULE = "=" * 80 + "\n"


def ros2_name(name: str) -> str:
    """The name of a message type as ROS 2 writes it."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


class Decoder:
    """Decodes the messages of channels. ``store`` is rosbags' store of their types."""

    def __init__(self) -> None:
        self._typesys = importlib.import_module("rosbags.typesys")
        self.store = self._typesys.get_typestore(self._typesys.Stores.EMPTY)
        # Before ROS Iron, bags hold no definitions of their messages; those read here never changed.
        self._known = self._typesys.get_typestore(self._typesys.Stores.LATEST).fielddefs

    def learn(self, channels: Sequence[Channel]) -> list[str]:
        """Learn the types of channels; returns for each why its messages cannot be read, "" if they can. Of a
        type that is known already the first definition stays."""
        types: dict[str, Any] = {}
        problems = []
        for channel in channels:
            try:
                if channel.encoding not in (CDR, ROS1):
                    raise ValueError(f"its messages are {channel.encoding}")
                types |= self._defined(channel)
                problems.append("")
            except Exception as error:  # the library raises many kinds of errors
                problems.append(said(error))
        self.store.register({name: each for name, each in types.items() if name not in self.store.fielddefs})
        return problems

    def decode(self, type: str, encoding: str, data: bytes) -> Any:
        """A message of a type that was learnt. Raises errors of many kinds for damaged data."""
        if encoding == ROS1:
            return self.store.deserialize_ros1(data, type)
        return self.store.deserialize_cdr(data, type)

    def _defined(self, channel: Channel) -> dict[str, Any]:
        """The types of a channel's messages, by its definition or those that are known."""
        text, known = channel.definition, self._known if channel.encoding == CDR else {}
        if channel.language == "NONE":
            if known and channel.type not in known:
                raise ValueError("its definition was not sent, and it is none of ROS's own types")
            return known
        try:
            if channel.language == "MSG":
                return dict(self._typesys.get_types_from_msg(text, channel.type))
            from_idl = self._typesys.get_types_from_idl
            if not text.startswith(f"{_IDL_RULE}IDL: "):
                return dict(from_idl(text))
            parts = [part.split("\n", 1)[1] for part in text.split(_IDL_RULE)[1:]]
            return {name: each for part in parts for name, each in from_idl(part).items()}
        except Exception:
            if channel.type in known:
                return known
            raise
