"""The maps of the toy method: those of log-odds."""

from typing import ClassVar

from toy_method.plug import METHOD

from taichi_mrf.config.method import Method
from taichi_mrf.methods.log_odds.map import LogOddsMap


class ToyMap(LogOddsMap):
    """A map of the toy method."""

    METHOD: ClassVar[Method] = METHOD
