"""Messages between the tuning process and its page, in addition to those of viewer/messages.py."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.method import Range
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.messages import Request, Update
from taichi_mrf.viewer.tune.scores import Scores

By = Literal["start", "hand", "search"]
"""Source of the parameters of a try: the start, the user, or the automatic search."""


@dataclass(frozen=True)
class FrameChoice:
    """The working set: the frames of a sequence that parameters are tuned on."""

    first: Annotated[int, Range(0, 10_000, 1)] = 0
    """Index of the first frame."""

    stride: Annotated[int, Range(0, 50, 1)] = 0
    """Take every n-th frame from there; 0 spreads them evenly, at most 10 apart."""

    count: Annotated[int, Range(3, 60, 1)] = 12
    """Number of frames, including those that are held out."""

    hold_out: Annotated[int, Range(2, 10, 1)] = 3
    """Hold out one frame in n: it is not mapped but used to score the map."""

    def __post_init__(self) -> None:
        for name, least in (("first", 0), ("stride", 0), ("count", 2), ("hold_out", 2)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, not {getattr(self, name)}")


@dataclass(frozen=True)
class Tuning(Update):
    """The first update, and the first for another working set; the table of tries is emptied. ``config`` are
    the first parameters; ``training``, ``held_out`` and ``unseen`` are the names of frames."""

    source: str
    backend: str
    device: str
    config: Config
    choice: FrameChoice
    frames: int
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    unseen: tuple[str, ...]


@dataclass(frozen=True)
class Activity(Update):
    """Activity of the session, and how much of it is done (0 to 1)."""

    text: str
    share: float
    busy: bool


@dataclass(frozen=True)
class Tried(Update):
    """A try and its scores. A later message with the same ``number`` has scores of more pixels: a first look
    maps and scores some of them, then all are."""

    number: int
    config: Config
    scores: Scores
    by: By


@dataclass(frozen=True)
class Pinned(Update):
    """Other tries are compared with this one."""

    number: int


@dataclass(frozen=True)
class Chosen(Update):
    """Map, pictures and plot are now those of this try, and the sliders show its parameters."""

    number: int
    config: Config


@dataclass(frozen=True)
class Residuals(Update):
    """Measured minus expected depth at pixels of the held-out frames, in metres, (n,) each, by depth; and
    over bins of the depth ``bin_m`` (b,) their ``median`` and ``spread``, half the width of their middle
    68%."""

    number: int
    depth_m: NDArray[np.float32]
    residual_m: NDArray[np.float32]
    bin_m: NDArray[np.float64]
    median_m: NDArray[np.float64]
    spread_m: NDArray[np.float64]


@dataclass(frozen=True)
class HeldOutView(Update):
    """Accuracy of the map in one held-out view, and of the reference, if there is one, and what changed
    between the two. Pictures are (h, w, 3) uint8."""

    name: str
    measured: NDArray[np.uint8]
    accuracy: NDArray[np.uint8]
    title: str
    reference: NDArray[np.uint8] | None
    reference_title: str
    change: NDArray[np.uint8] | None
    change_title: str


@dataclass(frozen=True)
class Try(Request):
    """Map with these parameters; the try in progress is abandoned."""

    config: Config


@dataclass(frozen=True)
class Pin(Request):
    """Compare other tries with this one."""

    number: int


@dataclass(frozen=True)
class LookAt(Request):
    """Show this held-out view, by its index among them."""

    view: int


@dataclass(frozen=True)
class ChooseFrames(Request):
    """Tune on another working set."""

    choice: FrameChoice


@dataclass(frozen=True)
class SaveTries(Request):
    """Send a file to a client: the parameters of a try (yaml), or the table of all tries (csv)."""

    kind: Literal["yaml", "csv"]
    number: int
    client: int


@dataclass(frozen=True)
class StopSearch(Request):
    """End the automatic search and keep the best parameters."""
