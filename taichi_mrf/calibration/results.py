"""The files of a calibration: tables that a map can be made with, and pictures."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import LearntNoise
from taichi_mrf.calibration.frustum_picture import frustum_picture
from taichi_mrf.calibration.no_return import NoReturnFit
from taichi_mrf.calibration.noise_pictures import curves_picture, maps_picture
from taichi_mrf.system.atomic import atomic_path, write_npz, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMA_FILE, BIAS_FILE, NOISE_FILE, CONFIG_FILE = "sigma.npy", "bias.npy", "noise.npz", "sensor.yaml"
_DPI = 110


def write_noise(folder: Path, noise: LearntNoise, no_return: NoReturnFit | None = None) -> list[Path]:
    """Write the tables, ``noise.npz`` for PatchNoise.load, and last a ``sensor.yaml`` that names the tables.

    ``noise.npz`` also holds the covariances of the coefficients, (patches, degree + 1, degree + 1), and
    which patches needed no neighbour, and the samples of each patch and depth bin, (patches, bins), with the
    bins' limits. ``sensor.yaml`` has the chance of no return, if it was learnt. Returns the paths. Raises
    MapFileError.
    """
    _write_table(folder / SIGMA_FILE, noise.sigma.coefficients)
    _write_table(folder / BIAS_FILE, noise.bias.coefficients)
    write_npz(
        folder / NOISE_FILE,
        {
            **noise.model().arrays(),
            "sigma_covariance": noise.sigma.covariance,
            "bias_covariance": noise.bias.covariance,
            "own": noise.own,
            "counts": noise.counts,
            "depth_edges": noise.cells.edges,
        },
    )
    fields = {} if no_return is None else {"no_return": "model", **no_return.fields()}
    lines = "".join(f"  {name}: {value}\n" for name, value in fields.items())
    write_text(folder / CONFIG_FILE, _sensor_yaml(noise) + lines)
    return [folder / name for name in (CONFIG_FILE, SIGMA_FILE, BIAS_FILE, NOISE_FILE)]


def write_pictures(folder: Path, noise: LearntNoise, coverage: Coverage) -> list[Path]:
    """Write ``noise_curves.png``, ``noise_maps.png`` and ``coverage.png``. Raises MapFileError."""
    figures: dict[str, Figure] = {
        "noise_curves.png": curves_picture(noise, coverage),
        "noise_maps.png": maps_picture(noise, coverage),
        "coverage.png": frustum_picture(coverage, noise.counts),
    }
    for name, figure in figures.items():
        with atomic_path(folder / name) as temporary:
            figure.savefig(temporary, dpi=_DPI)
    return [folder / name for name in figures]


def _write_table(path: Path, table: NDArray[np.float64]) -> None:
    with atomic_path(path) as temporary:
        np.save(temporary, table)


def _sensor_yaml(noise: LearntNoise) -> str:
    camera, options = noise.cells.camera, noise.cells.options
    return (
        f"# Learnt noise of a depth camera at {camera.width} x {camera.height} pixels.\n"
        "# Use it with: taichi-mrf map SOURCE --out DIR --config FILE\n"
        "sensor:\n"
        f"  sigma_table: {SIGMA_FILE}\n"
        f"  bias_table: {BIAS_FILE}\n"
        f"  patch: {options.patch}\n"
        f"  min_depth: {options.min_depth}\n"
        f"  max_depth: {options.max_depth}\n"
    )
