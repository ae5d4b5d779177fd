"""The parameters of learning a sensor's noise. As in config.py, the string under a field is its help, and
nothing in this file needs NumPy, so that ``taichi-mrf --help`` is fast.
"""

import math
from dataclasses import dataclass, field

from taichi_mrf.errors import ConfigError

HIGHEST_DEGREE = 4
"""The map's kernels take sensor.noise.TERMS coefficients."""

LEAST_CORNERS = 3
"""Inner corners along each side of a chessboard that OpenCV can find."""


@dataclass(frozen=True)
class BoardConfig:
    """The chessboard that gives ground truth. It must be flat."""

    columns: int = 0
    """Inner corners along a row of the chessboard: one less than the squares."""

    rows: int = 0
    """Inner corners along a column."""

    square: float = 0.0
    """Side of a square in metres, as measured on the print."""

    border: float = 0.5
    """Margin of the pixels in use beyond the outermost inner corners, in squares. 1 is the edge of the outer
    squares, where many sensors mix board and background."""

    largest_reprojection: float = 1.0
    """Leave out images whose corners have a larger reprojection error than this (pixels, RMS)."""

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            corners = getattr(self, name)
            _check(corners == 0 or corners >= LEAST_CORNERS, f"board.{name}", "must be at least 3 corners")
        _check(math.isfinite(self.square) and self.square >= 0, "board.square", "must be positive")
        _check(0 <= self.border <= 1, "board.border", "must lie between 0 and 1 squares")
        _check(self.largest_reprojection > 0, "board.largest_reprojection", "must be positive")

    def require(self) -> None:
        """Raise ConfigError, naming the field, unless the board is fully described."""
        for name in ("columns", "rows", "square"):
            _check(getattr(self, name) > 0, f"board.{name}", "must be given to find the chessboard")


@dataclass(frozen=True)
class MotionCaptureConfig:
    """Alignment in time of motion capture and images."""

    largest_lag: float = 1.0
    """Largest time lag between the two streams that is searched, in seconds either way."""

    largest_gap: float = 0.05
    """Largest gap between poses of motion capture (seconds); larger gaps are not interpolated."""

    least_correlation: float = 0.6
    """Minimum correlation between the board's speeds in the images and in motion capture; below it the two
    streams are refused."""

    def __post_init__(self) -> None:
        _check(self.largest_lag >= 0, "motion_capture.largest_lag", "must not be negative")
        _check(self.largest_gap > 0, "motion_capture.largest_gap", "must be positive")
        ok = 0 < self.least_correlation < 1
        _check(ok, "motion_capture.least_correlation", "must lie between 0 and 1")


@dataclass(frozen=True)
class CalibrationConfig:
    """Learning of bias and sigma (MRFMap, section IV-C). Depths are axial depth in metres."""

    patch: int = 20
    """Side in pixels of the square patches, each of which gets its own polynomials."""

    degree: int = 2
    """Degree of the polynomials in depth."""

    min_depth: float = 0.3
    """Nearest depth that the sensor is used at; nearer samples are ignored."""

    max_depth: float = 5.0
    """Furthest depth that the sensor is used at. Sigma is kept positive from min_depth to max_depth."""

    bin_width: float = 0.1
    """Width of a depth bin in metres."""

    least_count: int = 50
    """Minimum number of samples in a patch's depth bin; other bins are ignored."""

    least_span: float = 0.5
    """A patch borrows from its neighbours if its bins span less than this share of the depths that
    the best covered patches span."""

    outlier_sigmas: float = 5.0
    """Samples further than this many robust standard deviations from the median of their patch and bin are
    left out; the map's inference.outlier_floor accounts for these."""

    least_sigma: float = 1e-4
    """Lower bound on sigma in metres, from min_depth to max_depth. The map itself uses at least 1 mm."""

    board: BoardConfig = field(default_factory=BoardConfig)
    """The chessboard, where one is used."""

    motion_capture: MotionCaptureConfig = field(default_factory=MotionCaptureConfig)
    """Motion capture, where it is used."""

    def __post_init__(self) -> None:
        _check(self.patch >= 1, "patch", "must be at least 1 pixel")
        _check(0 <= self.degree <= HIGHEST_DEGREE, "degree", f"must lie between 0 and {HIGHEST_DEGREE}")
        _check(self.min_depth >= 0, "min_depth", "must not be negative")
        _check(math.isfinite(self.max_depth), "max_depth", "must be finite")
        _check(self.max_depth > self.min_depth, "max_depth", "must be more than min_depth")
        _check(self.bin_width > 0, "bin_width", "must be positive")
        ok = (self.max_depth - self.min_depth) / self.bin_width <= 1000
        _check(ok, "bin_width", "makes more than 1000 bins of the range from min_depth to max_depth")
        _check(self.least_count >= 10, "least_count", "must be at least 10")
        _check(0 < self.least_span <= 1, "least_span", "must lie between 0 and 1")
        _check(
            self.outlier_sigmas >= 3, "outlier_sigmas", "must be at least 3: nearer samples are no outliers"
        )
        _check(self.least_sigma > 0, "least_sigma", "must be positive")


def _check(ok: bool, name: str, problem: str) -> None:
    if not ok:
        raise ConfigError(f"{name} {problem}")
