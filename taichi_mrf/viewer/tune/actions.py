"""Actions of a user on the tuning page, as events for the page."""

from dataclasses import dataclass
from enum import Enum, auto

from taichi_mrf.viewer.transport.inbox import Event


class Action(Enum):
    """A button, or a widget whose value asks the tuning process for something."""

    STOP_SEARCH = auto()
    USE_FRAMES = auto()
    CHOOSE_VIEW = auto()
    RESTORE = auto()
    PIN = auto()
    SAVE_YAML = auto()
    SAVE_CSV = auto()


@dataclass(frozen=True)
class KnobMoved(Event):
    """The slider or box of the parameter of this name was used."""

    name: str
