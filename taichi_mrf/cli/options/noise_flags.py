"""The flag of map, live and tune for a noise that is learnt from the recording itself."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class NoiseFlags:
    """Where sigma comes from."""

    origin: Annotated[Literal["checked", "given", "auto"], tyro.conf.arg(name="noise")] = "checked"
    """auto learns sigma from the recording before anything else: up to 60 of its frames are mapped up to
    three times, and held-out ones say by how much sensor.sigma, or what frames state, is off. The result is
    sensor.sigma-scale and sensor.sigma-added; DIR/sensor.yaml holds it for other recordings, and for a
    camera, which has to be recorded first. checked does so in map alone, where neither parameters nor the
    recording say anything of noise and a quick map of 16 of 64 or more frames contradicts the default. given
    never does."""

    @property
    def is_learnt(self) -> bool:
        """Whether sigma is to be learnt."""
        return self.origin == "auto"

    @property
    def is_checked(self) -> bool:
        """Whether it is to be learnt if it is the default and held-out frames contradict it."""
        return self.origin == "checked"

    def refuse_with(self, **flags: object) -> None:
        """Raises ConfigError if sigma is to be learnt and one of some other flags is set."""
        clashing = [f"--{name.replace('_', '-')}" for name, value in flags.items() if value]
        if self.is_learnt and clashing:
            raise ConfigError(
                f"--noise auto does not work with {' or '.join(clashing)}: learn the noise in a run without, "
                "and pass its sensor.yaml with --config"
            )
