"""The scores of a try: their labels, which direction is better, their format."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

Better = Literal["higher", "lower", "neither"]


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
    """How one score is shown: multiplied by ``factor``, formatted with ``form``, with a unit."""

    name: str
    label: str
    better: Better
    factor: float = 1.0
    form: str = ".3f"
    unit: str = ""

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


KINDS = (
    ScoreKind("accuracy_voxel", "right, in the voxel", "higher", 100, ".1f", "%"),
    ScoreKind("accuracy_sigma", "right, 1.5 sigma", "higher", 100, ".1f", "%"),
    ScoreKind("accuracy_5cm", "right, 5 cm", "higher", 100, ".1f", "%"),
    ScoreKind("unanswered", "no surface", "lower", 100, ".1f", "%"),
    ScoreKind("median_abs_m", "median depth error", "lower", 1000, ".1f", "mm"),
    ScoreKind("rms_m", "RMS depth error", "lower", 1000, ".0f", "mm"),
    ScoreKind("log_likelihood", "log-likelihood", "higher", 1, "+.3f"),
    ScoreKind("depth_calibration", "calibration, depth", "lower", 100, ".1f", "%"),
    ScoreKind("voxel_calibration", "calibration, voxels", "lower", 100, ".2f", "%"),
    ScoreKind("seconds", "seconds", "lower", 1, ".2f", "s"),
    ScoreKind("voxels", "voxels", "neither", 1, ",.0f"),
    ScoreKind("keyframes", "keyframes", "neither", 1, ".0f"),
)
"""In the order of the page."""


def scores_in_words(scores: Scores) -> list[str]:
    """One line for each score that is known."""
    lines = [f"{kind.label}: {kind.text(scores)}" for kind in KINDS if math.isfinite(kind.value(scores))]
    if scores.pixel_stride > 1:
        lines.append(f"of one pixel in {scores.pixel_stride**2} only")
    return lines


def figures(scores: Scores) -> dict[str, float]:
    """All scores by name."""
    return dataclasses.asdict(scores)
