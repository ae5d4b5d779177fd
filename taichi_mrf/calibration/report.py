"""The result of a calibration as plain values for ``report.json``, and remarks for the user."""

import dataclasses
from typing import Any

import numpy as np

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import NEIGHBOURS, LearntNoise
from taichi_mrf.calibration.learning import Calibration
from taichi_mrf.calibration.noise_pictures import central_third

DEPTHS = 5
"""Depths of the covered range at which the report gives bias and sigma."""

LARGE_MISFIT = 4.0
"""Above this the bins lie twice as far from the polynomial as independent samples would."""


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
