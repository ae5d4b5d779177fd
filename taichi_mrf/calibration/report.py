"""The result of a calibration: files that a map can be made with, pictures, plain values for ``report.json``,
and remarks for the user."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import NEIGHBOURS, Calibration, LearntNoise
from taichi_mrf.calibration.no_return import NoReturnFit
from taichi_mrf.calibration.noise_pictures import central_third, curves_picture, frustum_picture, maps_picture
from taichi_mrf.system.atomic import atomic_path, write_npz, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DEPTHS = 5
"""Depths of the covered range at which the report gives bias and sigma."""

LARGE_MISFIT = 4.0
"""Above this the bins lie twice as far from the polynomial as independent samples would."""
SIGMA_FILE, BIAS_FILE, NOISE_FILE, CONFIG_FILE = "sigma.npy", "bias.npy", "noise.npz", "sensor.yaml"
_DPI = 110


def calibration_report(calibration: Calibration, coverage: Coverage) -> dict[str, Any]:
    """The facts; lengths in metres. Values that do not exist are None."""
    noise = calibration.noise
    near, far = coverage.depth_range()
    misfit = noise.misfit[np.isfinite(noise.misfit)]
    return {
        "images": calibration.frames,
        "samples": calibration.samples,
        "outliers": calibration.outliers,
        "patches": len(noise.own),
        "patches_that_borrowed": int((~noise.own).sum()),
        "patches_with_lifted_sigma": int(noise.lifted.sum()),
        "covered_from": near,
        "covered_to": far,
        "covered_cells": coverage.share,
        "not_covered": coverage.in_words(),
        "misfit": float(np.median(misfit)) if len(misfit) else None,
        "noise": _at_depths(noise, near, far),
        "options": dataclasses.asdict(noise.cells.options),
    }


def remarks(calibration: Calibration) -> list[str]:
    """Remarks for the user, besides the numbers."""
    noise, options = calibration.noise, calibration.noise.cells.options
    texts = []
    if calibration.empty_frames:
        texts.append(
            f"{len(calibration.empty_frames)} images have no pixel with both depths and are not used"
        )
    borrowed = int((~noise.own).sum())
    if borrowed and noise.own.sum() < NEIGHBOURS:
        texts.append(f"{borrowed} patches have too little data and got one curve made from all samples")
    elif borrowed:
        texts.append(f"{borrowed} patches have too little data and borrowed from their neighbours")
    if noise.lifted.any():
        texts.append(
            f"sigma of {int(noise.lifted.sum())} patches was kept from falling below "
            f"{options.least_sigma:g} m between {options.min_depth:g} and {options.max_depth:g} m"
        )
    misfit = float(np.nanmedian(noise.misfit)) if np.isfinite(noise.misfit).any() else 0.0
    if misfit > LARGE_MISFIT:
        texts.append(
            f"bins lie {np.sqrt(misfit):.1f} times as far from the bias polynomials as independent samples "
            f"would: the errors of one image are correlated, or degree {options.degree} is too low; standard "
            "errors are too small by this factor"
        )
    return texts


def _at_depths(noise: LearntNoise, near: float, far: float) -> list[dict[str, float]]:
    depths = np.linspace(near, far, DEPTHS)
    bias, sigma = noise.bias.at(depths), noise.sigma.at(depths)
    centre = central_third(noise)
    return [
        {
            "depth": float(depth),
            "bias_median": float(np.median(bias[:, k])),
            "bias_centre": float(bias[centre, k].mean()),
            "sigma_median": float(np.median(sigma[:, k])),
            "sigma_centre": float(sigma[centre, k].mean()),
        }
        for k, depth in enumerate(depths)
    ]


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
