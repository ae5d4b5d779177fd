"""Motion that a live run reports: the share of dynamic voxels, and the list of what came or went.

    python benchmarks/still.py FOLDER --limit 100

The recording is mapped as the live page does, without a browser, and the list of changes is asked after every
keyframe, not only as often as there is time. Where nothing moves, all that is printed is false.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import tyro

from taichi_mrf.cli.options.config_file import live_defaults
from taichi_mrf.config.schema import Config
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.session import shown_extras
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import open_source
from taichi_mrf.viewer.messages import KeyframeInfo, Request, SceneChanges, Update


@dataclass(frozen=True)
class Options:
    """Recording to replay."""

    source: Annotated[str, tyro.conf.Positional]
    """A recording or a built-in sequence."""

    every: int = 1
    """Use only every N-th frame."""

    limit: int | None = None
    """Use at most N frames."""

    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=live_defaults)
    """Parameters."""


class Listener:
    """Stands for the page. ``listed`` are the changes that it was told of; ``dynamic`` is the share of the
    occupied voxels that are dynamic, after each keyframe."""

    lost: str | None = None

    def __init__(self) -> None:
        self.listed: list[str] = []
        self.dynamic: list[float] = []
        self.map: MRFMap | None = None
        self._newest: tuple[object, ...] = ()

    def send(self, update: Update) -> None:
        """Note what is told of changes."""
        if isinstance(update, KeyframeInfo) and self.map is not None and self.map.keyframes:
            self.dynamic.append(dynamic_share(self.map))
        if isinstance(update, SceneChanges):
            new = [each for each in update.changes if each not in self._newest]
            self._newest = update.changes
            for each in reversed(new):
                size = " x ".join(f"{side:.1f}" for side in each.size_m)
                centre = ", ".join(f"{at:.1f}" for at in each.centre_m)
                self.listed.append(f"{each.stamp_s:.2f} s: {size} m {each.verb} at {centre}")

    def requests(self) -> list[Request]:
        """Nobody asks for anything."""
        return []

    def wait(self, timeout: float) -> None:
        """Nobody will."""


def dynamic_share(m: MRFMap) -> float:
    """The share of a map's occupied voxels that are in its dynamic layer."""
    return len(m.dynamic.voxels()[0]) / max(1, len(m.marginals.voxels()[0]))


def main() -> None:
    """Print both."""
    options = tyro.cli(Options, description=__doc__)
    shown_extras.SHARE_OF_TIME = math.inf
    source, _ = open_source(
        options.source, options.settings, every=options.every, limit=options.limit, speed=0.0, loop=False
    )
    listener = Listener()
    session = Session(source, listener, Policy(leave_when_done=True))
    m = session.state.mapper.map
    assert isinstance(m, MRFMap)
    listener.map = m
    session.run(lambda: False)
    shares = 100 * np.array(listener.dynamic)
    print(
        f"{options.source}: {len(m.keyframes)} keyframes, {len(m.marginals.voxels()[0])} voxels, "
        f"{len(m.dynamic.voxels()[0])} dynamic at the end ({100 * dynamic_share(m):.3f}%), on the way "
        f"{shares.mean():.3f}% in the mean and {shares.max():.3f}% at most; {len(listener.listed)} lines"
    )
    for line in listener.listed:
        print(" ", line)


if __name__ == "__main__":
    main()
