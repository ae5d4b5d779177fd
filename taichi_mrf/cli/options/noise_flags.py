"""The flag of map, live and tune for a noise that is learnt from the recording itself."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class NoiseFlags:
    """Source of sigma."""

    origin: Annotated[Literal["checked", "given", "auto"], tyro.conf.arg(name="noise")] = "checked"
    """auto learns sigma from up to 60 frames first (DIR/sensor.yaml keeps it for other recordings); checked,
    in map alone, from 16 frames, where sigma is the default and these contradict it; given never."""

    @property
    def is_learnt(self) -> bool:
        """True if sigma is to be learnt."""
        return self.origin == "auto"

    @property
    def is_checked(self) -> bool:
        """True if it is to be learnt if it is the default and held-out frames contradict it."""
        return self.origin == "checked"

    def refuse_with(self, **flags: object) -> None:
        """Raises ConfigError if sigma is to be learnt and one of some other flags is set."""
        clashing = [f"--{name.replace('_', '-')}" for name, value in flags.items() if value]
        if self.is_learnt and clashing:
            raise ConfigError(
                f"--noise auto does not work with {' or '.join(clashing)}: learn the noise in a run without, "
                "and pass its sensor.yaml with --config"
            )
