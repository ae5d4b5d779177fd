"""Messages between the tuning process and its page, in addition to those of viewer/messages.py, and the
scores of a try: their labels, which direction is better, their format.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.method import Range
from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.messages import Request, Update

Better = Literal["higher", "lower", "neither"]
Objective = Literal["right", "depth-error", "fit"]
"""Aim of a search, by a word for the score."""


@dataclass(frozen=True)
class Scores:
    """How well a map of the training frames predicts the held-out ones, over all their pixels.

    With a ``pixel_stride`` of n only every n-th pixel along both sides was mapped and scored.
    """

    accuracy_voxel: float
    """Share of pixels whose depth lies in the voxel of the likeliest surface; no surface counts as wrong."""

    accuracy_sigma: float
    """Share of pixels whose depth lies within 1.5 sigma (the voxel size) of that voxel's middle."""

    accuracy_5cm: float
    """Share of pixels whose depth lies within 5 cm of that voxel's middle."""

    unanswered: float
    """Share of pixels whose ray meets no surface."""

    median_abs_m: float
    """Median absolute difference of expected and measured depth, in metres."""

    rms_m: float
    """Root mean square of the same difference, in metres."""

    log_likelihood: float
    """Mean log density, per metre, of the measurements under the map and the sensor's noise."""

    depth_calibration: float
    """Mean difference between the share of measurements inside the map's central intervals of depth and the
    nominal share."""

    voxel_calibration: float
    """Expected calibration error of the voxels' probabilities where the scene's ground truth is known, else
    NaN."""

    seconds: float
    """Time to make the map."""

    voxels: int
    """Voxels that the map holds."""

    keyframes: int
    """Training frames that became keyframes."""

    pixel_stride: int = 1


@dataclass(frozen=True)
class ScoreKind:
    """How one score is shown: multiplied by ``factor``, formatted with ``form``, with a unit. One
    ``in_voxels`` only compares maps whose voxels have the same size."""

    name: str
    label: str
    better: Better
    factor: float = 1.0
    form: str = ".3f"
    unit: str = ""
    in_voxels: bool = False

    def text(self, scores: Scores) -> str:
        """The score as text."""
        return self.format(self.value(scores))

    def value(self, scores: Scores) -> float:
        """The score as it is stored, in SI units."""
        return float(getattr(scores, self.name))

    def format(self, value: float) -> str:
        """A value of this kind as text; a dash for NaN."""
        if not math.isfinite(value):
            return "–"
        return f"{value * self.factor:{self.form}}" + (f" {self.unit}" if self.unit else "")

    def difference(self, value: float, before: float) -> str:
        """How much two values of this kind differ, with a sign, as text."""
        return f"{(value - before) * self.factor:+{self.form.lstrip('+')}}"


KINDS = (
    ScoreKind("accuracy_voxel", "right, in the voxel", "higher", 100, ".1f", "%", True),
    ScoreKind("accuracy_sigma", "right, 1.5 voxels", "higher", 100, ".1f", "%", True),
    ScoreKind("accuracy_5cm", "right, 5 cm", "higher", 100, ".1f", "%"),
    ScoreKind("unanswered", "no surface", "lower", 100, ".1f", "%"),
    ScoreKind("median_abs_m", "median depth error", "lower", 1000, ".1f", "mm"),
    ScoreKind("rms_m", "RMS depth error", "lower", 1000, ".0f", "mm"),
    ScoreKind("log_likelihood", "fit, log-likelihood", "higher", 1, "+.3f"),
    ScoreKind("depth_calibration", "calibration, depth", "lower", 100, ".1f", "%"),
    ScoreKind("voxel_calibration", "calibration, voxels", "lower", 100, ".2f", "%", True),
    ScoreKind("seconds", "time to map", "lower", 1, ".2f", "s"),
    ScoreKind("voxels", "voxels", "neither", 1, ",.0f"),
    ScoreKind("keyframes", "keyframes", "neither", 1, ".0f"),
)
"""In the order of the page."""

_BY_NAME = {kind.name: kind for kind in KINDS}


def headline(one_size: bool) -> dict[Objective, ScoreKind]:
    """The scores that the page shows first, of which each can be the aim of a search; unless all maps have
    voxels of one size, pixels are right within centimetres."""
    return {
        "right": _BY_NAME["accuracy_sigma" if one_size else "accuracy_5cm"],
        "depth-error": _BY_NAME["median_abs_m"],
        "fit": _BY_NAME["log_likelihood"],
    }


def scores_in_words(scores: Scores) -> list[str]:
    """One line for each score that is known."""
    lines = [f"{kind.label}: {kind.text(scores)}" for kind in KINDS if math.isfinite(kind.value(scores))]
    if scores.pixel_stride > 1:
        lines.append(f"of one pixel in {scores.pixel_stride**2} only")
    return lines


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
    """Accuracy of the map in one held-out view. Pictures are (h, w, 3) uint8: ``accuracy`` is the
    reference, if there is one, beside the map; ``measured`` what changed between the two, if anything can
    have, beside the measured depth."""

    name: str
    accuracy: NDArray[np.uint8]
    title: str
    reference_title: str
    measured: NDArray[np.uint8]
    change_title: str


@dataclass(frozen=True)
class Verdict(Update):
    """Gain of a search: the scores, on ``views`` that were kept from it, of some parameters by name;
    the last are those that it has found. ``one_size``: their maps have voxels of the same size."""

    views: int
    scores: dict[str, Scores]
    one_size: bool = True


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
    """Send a file to a client: the parameters of a try (yaml) or those that the search has found (best), or
    the table of all tries (csv)."""

    kind: Literal["yaml", "csv", "best"]
    number: int
    client: int


@dataclass(frozen=True)
class StartSearch(Request):
    """Search from the parameters in force, with an empty table of tries."""

    objective: Objective = "fit"
    """Aim: most pixels right within 1.5 voxels (5 cm if voxel sizes are searched), smallest median depth
    error, or best fit. The fit counts how far the map's probabilities can be trusted, too."""

    tries: Annotated[int, Range(5, 200, 1)] = 30
    """Number of maps that the search makes."""


@dataclass(frozen=True)
class StopSearch(Request):
    """End the automatic search and keep the best parameters."""
