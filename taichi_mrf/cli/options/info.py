"""The options of ``taichi-mrf info``."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from taichi_mrf.config.schema import Arch
from taichi_mrf.datasets.source_flags import SourceFlags


@dataclass(frozen=True)
class Info:
    """Show the backend that runs here and why, what each backend can do, and versions; or, with SOURCE, what
    is in a recording and how to map it, or what is in a saved map.

    The exit status is 0 only if map accepts the recording. Example: taichi-mrf info walk.bag
    """

    source: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """A recording, as map takes it, or a saved map (map.npz, map.zarr, .bt, .ot). Of a bag, all topics are
    listed too."""

    arch: Arch = "auto"
    """Backend to start."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the facts as JSON instead of tables."""

    reading: Annotated[SourceFlags, tyro.conf.arg(name="")] = field(default_factory=SourceFlags)
    """How SOURCE is read."""
