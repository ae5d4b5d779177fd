"""``--publish`` of ``taichi-mrf live``: the map as messages for Foxglove and robots while it is made."""

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from taichi_mrf.cli.shared.serving import LOOPBACK, PrintLine
from taichi_mrf.errors import ConfigError

if TYPE_CHECKING:
    from taichi_mrf.session.message_server import MessageServer

_FORM = "foxglove, foxglove:PORT, foxglove:HOST:PORT, zenoh, zenoh:tcp/HOST:PORT or zenoh:...?domain=N"


@dataclass(frozen=True)
class PublishFlags:
    """Address at which the map is served to others."""

    publish: Annotated[str | None, tyro.conf.arg(metavar="foxglove[:PORT]|zenoh[:tcp/HOST:PORT]")] = None
    """Serve the map to Foxglove and to robots while it grows: voxels, the camera's path, tf, an octree for
    MoveIt, and the surface once the map has settled. At 127.0.0.1, port 8765; foxglove:0.0.0.0:8765 serves
    other machines, too. zenoh serves ROS 2 nodes that use rmw_zenoh, with ROS 2's types: those of this
    machine, or with zenoh:tcp/robot:7447 a robot's; ?domain=N is their ROS_DOMAIN_ID."""

    publish_every: Annotated[float, tyro.conf.arg(metavar="S")] = 1.0
    """Shortest time between two messages of a topic, in seconds."""

    publish_band: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="LOW HIGH")] = None
    """Serve a costmap for Nav2 of the obstacles between these heights, in metres along the axis up."""

    def __post_init__(self) -> None:
        if self.publish is not None:
            self._place()
        if not 0 <= self.publish_every < float("inf"):
            raise ConfigError(f"--publish-every must be 0 or a positive number, not {self.publish_every:g}")
        if self.publish_band is not None:
            low, high = self.publish_band
            if self.publish is None:
                raise ConfigError("--publish-band needs --publish foxglove or zenoh, which serve the costmap")
            if not -float("inf") < low < high < float("inf"):
                raise ConfigError(f"--publish-band must be two rising numbers, not {low:g} {high:g}")

    def serve(self, stack: ExitStack, print_line: PrintLine) -> "MessageServer | None":
        """Start the server, which ends with the ``stack``, if there is to be one. Raises TaichiMRFError."""
        if self.publish is None:
            return None
        from taichi_mrf.export.options import ExportOptions
        from taichi_mrf.session.message_server import MessageServer

        place, (low, high) = self._place(), self.publish_band or (None, None)
        server = MessageServer(
            **place, every_s=self.publish_every, options=ExportOptions(z_min=low, z_max=high)
        )
        stack.callback(server.close)
        host = place.get("host", "localhost")
        if host not in LOOPBACK:
            print_line(
                f"Warning: anyone who can reach {host} can watch the map at {server.address}: no password."
            )
        who = "ROS 2 nodes" if "zenoh" in place else "Foxglove and robots"
        print_line(f"{who} get the map at {server.address}")
        return server

    def _place(self) -> dict[str, Any]:
        """Arguments of MessageServer that say where it serves."""
        assert self.publish is not None
        wire, _, rest = self.publish.partition(":")
        if wire == "zenoh":
            address, _, domain = rest.partition("?domain=")
            if not (domain or "0").isdecimal() or "?" in address:
                raise ConfigError(f"--publish {self.publish}: must be {_FORM}")
            return {"zenoh": address, "domain": int(domain or 0)}
        host, _, port = rest.rpartition(":")
        if wire != "foxglove" or not (port.isdecimal() or self.publish == "foxglove"):
            raise ConfigError(f"--publish {self.publish}: must be {_FORM}")
        if port and int(port) > 65535:
            raise ConfigError(f"--publish {self.publish}: the port must lie between 0 and 65535")
        return {"host": host.strip("[]") or "127.0.0.1", **({"port": int(port)} if port else {})}
