"""Noise in map files: the map's noise model, and the evidence that keyframes state of their own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import MapFileError
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel, PatchNoise, PolynomialNoise
from taichi_mrf.sensor.own_evidence import OwnEvidence
from taichi_mrf.sensor.pose_doubt import checked_covariance
from taichi_mrf.system.npz_file import NpzFile


def noise_arrays(noise: NoiseModel, prefix: str = "") -> dict[str, NDArray[Any]]:
    """A noise model as arrays by name. Raises MapFileError for one that cannot be saved."""
    if isinstance(noise, PatchNoise):
        arrays = noise.arrays()
    elif isinstance(noise, PolynomialNoise):
        arrays = {"sigma": noise.sigma, "bias": noise.bias}
    else:
        raise MapFileError(f"a noise model of type {type(noise).__name__} cannot be saved")
    return {f"{prefix}noise_{name}": value for name, value in arrays.items()}


def read_noise(file: NpzFile, prefix: str = "") -> NoiseModel:
    """The noise model that :func:`noise_arrays` has made."""
    prefix = f"{prefix}noise_"
    if f"{prefix}patch" in file:
        width, height, *rest = file.array(f"{prefix}camera", "fi", (6,)).tolist()
        camera = PinholeCamera(int(width), int(height), *rest)
        sigma, bias = (file.array(prefix + name, "f", (None, None)) for name in ("sigma", "bias"))
        return PatchNoise(sigma, bias, file.scalar(f"{prefix}patch", "iu"), camera)
    sigma, bias = (file.array(prefix + name, "f", (1, None))[0] for name in ("sigma", "bias"))
    return PolynomialNoise(sigma, bias)


def evidence_arrays(own: OwnEvidence, prefix: str) -> dict[str, NDArray[Any]]:
    """Arrays of the evidence that a keyframe states; none if it states nothing."""
    arrays = {} if own.noise is None else noise_arrays(own.noise, prefix)
    if own.sigma_m is not None:
        arrays[f"{prefix}sigma_m"] = own.sigma_m
    if own.no_return is not None:
        arrays[f"{prefix}no_return"] = own.no_return
    if own.pose_covariance is not None:
        arrays[f"{prefix}pose_covariance"] = own.pose_covariance
    return arrays


def read_evidence(file: NpzFile, prefix: str, camera: Camera) -> OwnEvidence:
    """Evidence of a keyframe that :func:`evidence_arrays` has saved."""
    noise = read_noise(file, prefix) if f"{prefix}noise_sigma" in file else None
    sigma_m = None
    if f"{prefix}sigma_m" in file:
        sigma_m = file.array(f"{prefix}sigma_m", "f", camera.shape).astype(np.float32)
    no_return = None
    if f"{prefix}no_return" in file:
        no_return = file.array(f"{prefix}no_return", "b", camera.shape)
    covariance = None
    if f"{prefix}pose_covariance" in file:
        covariance = checked_covariance(file.array(f"{prefix}pose_covariance", "f", (6, 6)))
    return OwnEvidence(noise, sigma_m, no_return, covariance)
