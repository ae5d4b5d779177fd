"""What viewers do on the page, as it reaches the page's one owner.

viser calls back on a pool of threads. A callback only puts one of these into the owner's inbox.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class OptionsMoved:
    """Some widget of the view options was moved; the latest values count."""


@dataclass(frozen=True)
class Pressed:
    """A button, named by what is written on it, by one client."""

    button: str
    client: int


@dataclass(frozen=True)
class Chosen:
    """Something else was chosen in the widget of this name."""

    widget: str


@dataclass(frozen=True)
class KnobMoved:
    """The slider or box of the parameter of this name was used."""

    name: str


@dataclass(frozen=True)
class Clicked:
    """A click into the scene: the ray from the eye, in the world."""

    origin: tuple[float, float, float]
    direction: tuple[float, float, float]


@dataclass(frozen=True)
class Dragged:
    """The gizmo was let go."""


@dataclass(frozen=True)
class Joined:
    """A browser has connected."""

    client: int


Event = OptionsMoved | Pressed | Chosen | KnobMoved | Clicked | Dragged | Joined
