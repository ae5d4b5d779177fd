"""The options of ``taichi-mrf doctor``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.cli.options.shared import Reading
from taichi_mrf.config.schema import Arch
from taichi_mrf.datasets.source_flags import SourceFlags


@dataclass(frozen=True)
class Doctor:
    """Check that a recording is read correctly, and find the flag that corrects it if not.

    Doctor compares the depths of about twenty frames: as read, and with common errors in poses, stamps, units
    and intrinsics corrected. The exit status is 0 if the frames agree, 4 if something has to be corrected.
    Example: taichi-mrf doctor recording/ --picture overlap.png
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A recording, as map takes it."""

    poses: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """Poses of SOURCE's frames, in place of its own, as map takes them."""

    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a picture (.png) of two frames on top of each other, as read on the left and corrected on the
    right: green where they agree, red where one frame's points lie in front of the other's surface, blue
    behind it."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what was found as JSON."""

    arch: Arch = "auto"
    """Backend that renders a built-in source."""

    reading: Reading = field(default_factory=SourceFlags)
    """Options for reading SOURCE."""
