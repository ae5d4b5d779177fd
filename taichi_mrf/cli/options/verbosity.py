"""Flags for how much a command prints while it works."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class Verbosity:
    """How much is printed."""

    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print only problems, and JSON where it was asked for."""

    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print every step instead of a progress bar, and which backend was chosen and why."""

    def __post_init__(self) -> None:
        if self.quiet and self.verbose:
            raise ConfigError("--quiet and --verbose do not go together")
