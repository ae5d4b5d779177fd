"""``taichi-mrf live``: watch a map grow in the browser, and change it there."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.config_file import live_defaults
from taichi_mrf.cli.options.publish import PublishFlags
from taichi_mrf.cli.options.shared import (
    NoiseFlags,
    PoseFlags,
    Reading,
    Verbosity,
    check_least,
    check_onto,
    check_port,
)
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class Live:
    """Map a sequence or a camera, and show the map in the browser while it grows.

    On the page, keyframes can be switched off and on, moved and frozen, and rays inspected. The world may
    change: --time.half-life-s is 14400 here, but 0 (a static world) for map. Ctrl-C ends the run and, with
    --out, saves the map (exit status 130). Example: taichi-mrf live recording/ --out runs/desk --open
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = "synthetic:room"
    """A folder, whose format is recognised, a built-in sequence, a camera (realsense:), a running robot
    (foxglove:ws://robot:8765, or zenoh:tcp/robot:7447 of rmw_zenoh), or a saved map (map.npz). For a folder
    with several recordings or maps, the page offers all of them and starts with the first."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the results, created if needed: map.npz, voxels.ply, config.yaml, report.json,
    trajectory.txt if poses are tracked, and pictures unless the run is stopped."""

    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace the run that DIR holds. Without this flag, a folder that holds a run is refused."""

    onto: Annotated[Path | None, tyro.conf.arg(metavar="MAP")] = None
    """Continue the saved map of an earlier recording, with its parameters: SOURCE is located in it, and its
    keyframes are added to the map. A SOURCE that cannot be located with certainty is refused."""

    frozen: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """With --onto: keep the earlier keyframes as evidence only, without their images."""

    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """A YAML file of parameters, such as those in configs/."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use only every N-th frame."""

    limit: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Use at most N frames."""

    speed: Annotated[float, tyro.conf.arg(metavar="X")] = 0.0
    """Replay at X times the recorded speed; 0 replays as fast as possible."""

    loop: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Start over when the sequence ends; its frames become new keyframes."""

    keep_live: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Keep at most N keyframes editable and freeze the others, the oldest first (in a static world those out
    of view), so that an endless run needs a bounded amount of memory."""

    exit_when_done: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """End once the sequence is mapped."""

    host: str = "127.0.0.1"
    """Address to serve the page at. With any other address, everyone who can reach it can use the page."""

    port: int = 8080
    """Port to serve the page at; the next free one is taken if it is busy."""

    open: bool = False
    """Open the page in a browser on this machine."""

    reading: Reading = field(default_factory=SourceFlags)
    """Options for reading SOURCE."""

    poses: Annotated[PoseFlags, tyro.conf.arg(name="")] = field(default_factory=PoseFlags)
    """Use of SOURCE's poses."""

    noise: Annotated[NoiseFlags, tyro.conf.arg(name="")] = field(default_factory=NoiseFlags)
    """Source of sigma."""

    publishing: Annotated[PublishFlags, tyro.conf.arg(name="")] = field(default_factory=PublishFlags)
    """Address at which the map is served to others."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=live_defaults)
    """Parameters."""

    def __post_init__(self) -> None:
        check_least(self, every=1, limit=1, keep_live=1)
        if not 0 <= self.speed < float("inf"):
            raise ConfigError(f"--speed must be 0 or a positive number, not {self.speed:g}")
        check_port(self.port)
        self.noise.refuse_with(track_poses=self.poses.track_poses, onto=self.onto)
        check_onto(self.onto, self.frozen, self.poses)


@dataclass(frozen=True)
class Demo(Live):
    """Map a built-in room, and show it in the browser.

    Equals live --open without a SOURCE. Ctrl-C ends it.
    """

    open: bool = True
    """Open the page in a browser on this machine."""
