"""Learning a sensor's noise from pairs of measured and true depth: two passes over them, then the fit."""

from collections.abc import Callable
from dataclasses import dataclass

from taichi_mrf.calibration.fit import LearntNoise, learn
from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.pairs import PairSource
from taichi_mrf.calibration.samples import Cells, ErrorHistograms, Moments
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera


@dataclass(frozen=True)
class Calibration:
    """The learnt noise, the numbers of samples and frames, and the number of outliers."""

    noise: LearntNoise
    frames: int
    empty_frames: list[str]
    samples: int
    outliers: int


def calibrate(
    source: PairSource,
    camera: PinholeCamera,
    options: CalibrationConfig,
    progress: Callable[[int], None] = lambda number: None,
) -> Calibration:
    """Learn bias and sigma for each patch of the camera's image.

    ``progress`` gets the number of images read, twice the number of pairs at the end. Raises
    DatasetError if an image cannot be read or has the wrong size, if no pixel has both depths, or if
    there are too few samples.
    """
    cells = Cells(camera, options)
    histograms = ErrorHistograms(cells)
    empty = []
    measured = False
    for number, name in enumerate(source.names, start=1):
        pair = source.read(name)
        measured = measured or bool((pair.measured_m > 0).any())
        if histograms.add(pair) == 0:
            empty.append(name)
        progress(number)
    if not measured:
        raise DatasetError(f"none of the {len(source.names)} depth images contains a measurement")
    if histograms.samples == 0:
        raise DatasetError(
            f"in none of {len(source.names)} images a pixel has both measured and true depth from "
            f"{options.min_depth:g} to {options.max_depth:g} m"
        )
    moments = Moments(cells, histograms.limits())
    for number, name in enumerate(source.names, start=1):
        moments.add(source.read(name))
        progress(len(source.names) + number)
    counts = histograms.counts()
    noise = learn(moments, counts)
    return Calibration(noise, len(source.names) - len(empty), empty, histograms.samples, moments.outliers)
