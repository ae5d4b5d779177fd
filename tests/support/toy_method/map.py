"""The maps of the toy method: those of log-odds, with another parameter."""

from dataclasses import replace
from typing import ClassVar

from toy_method.plug import METHOD

from taichi_mrf.config.method import Method
from taichi_mrf.config.schema import Config
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.sensor.noise import NoiseModel


class ToyMap(LogOddsMap):
    """A map of the toy method."""

    METHOD: ClassVar[Method] = METHOD

    def _set_up(self, config: Config, noise: NoiseModel | None) -> None:
        log_odds = replace(config.log_odds, hit=config.toy.boldness)
        super()._set_up(replace(config, log_odds=log_odds), noise)
