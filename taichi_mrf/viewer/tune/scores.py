"""The figures of one try: what they are called, which way is better, how they are written."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

Better = Literal["higher", "lower", "neither"]


@dataclass(frozen=True)
class Scores:
    """How a map of the training frames does on the held-out ones, all their pixels together.

    ``pixel_stride`` says that only every so many-th pixel along both sides was mapped and judged.
    """

    accuracy_voxel: float
    """Share of pixels whose depth lies in the voxel of the likeliest surface; without an answer is wrong."""

    accuracy_sigma: float
    """The same for depths within 1.5 sigma of that voxel's middle, sigma being the voxel size."""

    accuracy_5cm: float
    """The same for depths within 5 cm of it."""

    unanswered: float
    """Share of pixels whose ray meets nothing."""

    median_abs_m: float
    """Median of the absolute difference of answer and measured depth, in metres."""

    rms_m: float
    """Root of its mean square, in metres."""

    log_likelihood: float
    """Mean log density, per metre, of the measurements under the map and the sensor's noise."""

    depth_calibration: float
    """Mean difference between how often measurements fall into the map's central intervals of depth and how
    often they ought to."""

    voxel_calibration: float
    """Expected calibration error of the voxels' probabilities, where the scene's truth is known, else NaN."""

    seconds: float
    """Time to make the map."""

    voxels: int
    """Voxels that the map holds."""

    keyframes: int
    """Training frames that became keyframes."""

    pixel_stride: int = 1


@dataclass(frozen=True)
class ScoreKind:
    """How one figure is shown: times ``factor``, as ``form`` says, with a unit."""

    name: str
    label: str
    better: Better
    factor: float = 1.0
    form: str = ".3f"
    unit: str = ""

    def text(self, scores: Scores) -> str:
        """The figure in words."""
        return self.format(self.value(scores))

    def value(self, scores: Scores) -> float:
        """The figure as it is stored, in SI units."""
        return float(getattr(scores, self.name))

    def format(self, value: float) -> str:
        """A value of this kind in words; a dash for none."""
        if not math.isfinite(value):
            return "–"
        return f"{value * self.factor:{self.form}}" + (f" {self.unit}" if self.unit else "")


KINDS = (
    ScoreKind("accuracy_voxel", "right, in the voxel", "higher", 100, ".1f", "%"),
    ScoreKind("accuracy_sigma", "right, 1.5 sigma", "higher", 100, ".1f", "%"),
    ScoreKind("accuracy_5cm", "right, 5 cm", "higher", 100, ".1f", "%"),
    ScoreKind("unanswered", "no answer", "lower", 100, ".1f", "%"),
    ScoreKind("median_abs_m", "median depth error", "lower", 1000, ".1f", "mm"),
    ScoreKind("rms_m", "RMS depth error", "lower", 1000, ".0f", "mm"),
    ScoreKind("log_likelihood", "log-likelihood", "higher", 1, "+.3f"),
    ScoreKind("depth_calibration", "calibration, depth", "lower", 100, ".1f", "%"),
    ScoreKind("voxel_calibration", "calibration, voxels", "lower", 100, ".2f", "%"),
    ScoreKind("seconds", "seconds", "lower", 1, ".2f", "s"),
    ScoreKind("voxels", "voxels", "neither", 1, ",.0f"),
    ScoreKind("keyframes", "keyframes", "neither", 1, ".0f"),
)
"""In the order in which they are shown."""


def scores_in_words(scores: Scores) -> list[str]:
    """One line for each figure that there is."""
    lines = [f"{kind.label}: {kind.text(scores)}" for kind in KINDS if math.isfinite(kind.value(scores))]
    if scores.pixel_stride > 1:
        lines.append(f"of one pixel in {scores.pixel_stride**2} only")
    return lines


def figures(scores: Scores) -> dict[str, float]:
    """All figures by name."""
    return dataclasses.asdict(scores)
