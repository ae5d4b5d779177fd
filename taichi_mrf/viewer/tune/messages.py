"""What tuning and its page tell each other, beside what every mapper and its page do (messages.py)."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config
from taichi_mrf.config.sliders import Range
from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.messages import Request, Update
from taichi_mrf.viewer.tune.scores import Scores

By = Literal["start", "hand", "search"]
"""Who came up with a try: it was there at first, a person set it, the automatic search did."""


@dataclass(frozen=True)
class FrameChoice:
    """The working set: which frames of a sequence parameters are tuned on."""

    first: Annotated[int, Range(0, 10_000, 1)] = 0
    """Index of the first frame."""

    stride: Annotated[int, Range(0, 50, 1)] = 0
    """Take every so many-th frame from there; 0 spreads them evenly, at most 10 apart."""

    count: Annotated[int, Range(3, 60, 1)] = 12
    """How many frames to take, those that are held out included."""

    hold_out: Annotated[int, Range(2, 10, 1)] = 3
    """One frame in so many is kept out of the map, to score it."""

    def __post_init__(self) -> None:
        for name, least in (("first", 0), ("stride", 0), ("count", 2), ("hold_out", 2)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, not {getattr(self, name)}")


@dataclass(frozen=True)
class Tuning(Update):
    """The first update, and again with another working set: what is tuned, on which frames. The table of
    tries begins anew. ``config`` is where tuning begins; ``held_out`` names the frames that score."""

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
    """What is being done, in words, and how much of it is (0 to 1)."""

    text: str
    share: float
    busy: bool


@dataclass(frozen=True)
class Tried(Update):
    """A try and its scores. The same ``number`` again brings better ones: first some of the pixels are
    mapped and judged, then all."""

    number: int
    config: Config
    scores: Scores
    by: By


@dataclass(frozen=True)
class Pinned(Update):
    """This try is the one that others are compared with."""

    number: int


@dataclass(frozen=True)
class Chosen(Update):
    """The map, the pictures and the plot are now those of this try, and the sliders shall stand where it had
    them."""

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
    """Where the map is right in one held-out view, beside the reference if there is one; and what became
    right or wrong between the two. Pictures are (h, w, 3) uint8."""

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
    """Map with these parameters; whatever was being tried before is abandoned."""

    config: Config


@dataclass(frozen=True)
class Pin(Request):
    """Compare with this try from now on."""

    number: int


@dataclass(frozen=True)
class LookAt(Request):
    """Show this held-out view, by its place among them."""

    view: int


@dataclass(frozen=True)
class ChooseFrames(Request):
    """Tune on other frames."""

    choice: FrameChoice


@dataclass(frozen=True)
class SaveTries(Request):
    """Make a file for a client: a try's parameters (yaml), or the table of all tries (csv)."""

    kind: Literal["yaml", "csv"]
    number: int
    client: int


@dataclass(frozen=True)
class StopSearch(Request):
    """End the automatic search; what it has found stays."""
