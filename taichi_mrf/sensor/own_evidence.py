"""Evidence that a keyframe states about its own measurements, in place of its map's assumptions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.limits import LEAST_SIGMA_M
from taichi_mrf.sensor.noise import NoiseModel, WidenedNoise
from taichi_mrf.sensor.pixel_sigma import PixelSigma
from taichi_mrf.sensor.pose_doubt import Covariance, DoubtfulPose, checked_covariance

NoReturn = NDArray[np.bool_] | NDArray[np.float32]
"""The pixels (H, W) that got no return from the world: bool; or float32, the depth in metres up to which
nothing of it is on the ray, -1 where the configuration says how far that is, and 0 for all others."""


def free_up_to_m(no_return: NoReturn) -> NDArray[np.float32]:
    """Pixels without a return as float32."""
    return -no_return.astype(np.float32) if no_return.dtype == np.bool_ else no_return.astype(np.float32)


@dataclass(frozen=True)
class OwnEvidence:
    """A keyframe's own noise model and its own sigma for each pixel, None for what its map assumes; its
    pixels that got no return, None if they are not known or do not count; and how uncertain its pose is, None
    if it is taken as exact.

    ``sigma_m`` is (H, W) float32, the standard deviation of each pixel's depth in metres; 0 stands for that
    of the noise model. ``no_return`` is a :data:`NoReturn`. ``pose_covariance`` is (6, 6), of a twist in the
    camera's frame (pose_doubt.py). ``images`` are those beside depth that layers of voxels follow from, but
    for colour, by name (voxels/layers.py): (H, W), or (H, W, channels).
    """

    noise: NoiseModel | None = None
    sigma_m: NDArray[np.float32] | None = None
    no_return: NoReturn | None = None
    pose_covariance: Covariance | None = None
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    def noise_model(self, default: NoiseModel, depth_m: NDArray[np.floating]) -> NoiseModel:
        """The noise of a depth image (H, W) whose map has the noise ``default``."""
        noise = default if self.noise is None else self.noise
        if self.sigma_m is not None:
            noise = PixelSigma(noise, self.sigma_m, depth_m)
        if self.pose_covariance is not None:
            noise = DoubtfulPose(noise, self.pose_covariance, depth_m)
        return noise

    def arguments(self) -> Mapping[str, Any]:
        """The arguments of ``add_keyframe`` that state this again: images if there are any, since not all
        methods take them."""
        stated = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in stated.items() if name != "images" or value}

    def content(self) -> bytes:
        """The evidence as bytes to sort by; empty if there is none. Images are none: no marginal depends on
        them."""
        noise, parts = self.noise, list[bytes]()
        if isinstance(noise, WidenedNoise):
            parts, noise = [noise.law.tobytes()], noise.noise
        if noise is not None:
            parts += [type(noise).__name__.encode(), *map(_bytes, vars(noise).values())]
        arrays = (self.sigma_m, self.no_return, self.pose_covariance)
        images = (array.tobytes() for array in arrays if array is not None)
        return b"".join([*parts, *images])

    @property
    def nbytes(self) -> int:
        """Bytes of its images in host memory, and of a sigma of its own that kernels read."""
        sigma = 0 if self.sigma_m is None else 2 * self.sigma_m.nbytes
        images = sum(image.nbytes for image in self.images.values())
        return sigma + images + (0 if self.no_return is None else self.no_return.nbytes)


NOTHING = OwnEvidence()
"""A keyframe of which the map's noise is true."""


def checked_evidence(
    depth_m: NDArray[np.float32],
    camera: Camera,
    noise: NoiseModel | None,
    sigma_m: ArrayLike | None,
    pose_covariance: ArrayLike | None = None,
) -> tuple[NDArray[np.float32], OwnEvidence]:
    """A keyframe's depth (H, W), 0 for no measurement, and what it states of it: copies of the arguments of
    ``add_keyframe``. A pixel of infinite sigma is no measurement. Raises KeyframeError for a wrong shape or
    type, and for a matrix that is no covariance."""
    if noise is not None and not isinstance(noise, NoiseModel):
        raise KeyframeError(
            f"noise must be a noise model such as PolynomialNoise, not {type(noise).__name__}"
        )
    covariance = checked_covariance(pose_covariance)
    if sigma_m is None:
        return depth_m, OwnEvidence(noise, pose_covariance=covariance)
    given = np.asarray(sigma_m)
    if given.shape != camera.shape or not np.issubdtype(given.dtype, np.floating):
        raise KeyframeError(
            f"sigma_m must be floating-point metres of the shape {camera.shape}, "
            f"not {given.dtype} {given.shape}"
        )
    with np.errstate(over="ignore"):
        sigma = given.astype(np.float32)
    depth_m = np.where(np.isposinf(sigma), np.float32(0.0), depth_m)
    stated = (depth_m > 0) & (sigma > 0)  # NaN is not
    sigma = np.where(stated, np.maximum(sigma, LEAST_SIGMA_M), np.float32(0.0))
    return depth_m, OwnEvidence(noise, sigma, pose_covariance=covariance)


def checked_no_return(
    no_return: ArrayLike | None, depth_m: ArrayLike, camera: Camera, counts: bool = True
) -> NoReturn | None:
    """A copy of the pixels that got no return, without those that hold a depth in the image as it was given:
    a return from too near is a return. None for None, and if there are none; those of -1 or True must count.
    Raises KeyframeError for a wrong shape or type."""
    if no_return is None:
        return None
    given, depth = np.asarray(no_return), np.asarray(depth_m)
    if given.shape != camera.shape or given.dtype not in (np.bool_, np.float32):
        raise KeyframeError(
            f"no_return must be bool or float32 of the shape {camera.shape}, not {given.dtype} {given.shape}"
        )
    kept = np.isfinite(given) & ~(np.isfinite(depth) & (depth > 0)) & (counts | (free_up_to_m(given) > 0))
    without: NoReturn = np.where(kept, given, given.dtype.type(0))
    return without if without.any() else None


def sigma_of_confidence(
    confidence: ArrayLike, depth_m: ArrayLike, noise: NoiseModel, camera: Camera, least: float = 0.1
) -> NDArray[np.float32]:
    """A sigma for each pixel, (H, W) metres, from a confidence between 0 and 1: the noise model's sigma at
    the measured depth, divided by the confidence.

    A confidence of 1 or more keeps the model's sigma. One below ``least`` counts as ``least``, so that sigma
    is at most 1 / ``least`` times the model's. 0, negative and NaN mean that the pixel holds no measurement:
    its sigma is infinite. Levels, such as ARKit's 0 to 2, have to be scaled first. Raises ConfigError for a
    wrong shape.
    """
    share, depth = array(confidence, "confidence"), array(depth_m, "depth_m")
    if share.shape != camera.shape or depth.shape != camera.shape:
        raise ConfigError(f"confidence and depth_m must be of the shape {camera.shape}")
    if not 0 < least <= 1:
        raise ConfigError(f"least must be above 0 and at most 1, not {least}")
    measured = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
    sigma = noise.table(camera).at_pixels(measured)[0] / np.clip(share, least, 1.0)
    return np.where(share > 0, sigma, np.inf).astype(np.float32)


def _bytes(value: Any) -> bytes:
    return value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
