"""One measurement of any depth camera or lidar."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import widened_noise
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.own_evidence import NoReturn, OwnEvidence, checked_no_return
from taichi_mrf.sensor.pose_doubt import checked_covariance, covariance_of

if TYPE_CHECKING:
    from taichi_mrf.sensor.motion import AccelerationSamples, GyroSamples
    from taichi_mrf.sensor.noise import NoiseModel


@dataclass(frozen=True)
class Frame:
    """A depth image with its pose and its camera.

    ``depth_m`` is depth along the camera's rays, (H, W) float32 in metres; 0 means no measurement. It is
    axial depth for a pinhole, and range where rays have the length 1, as a lidar's have. ``T_world_camera``
    is (4, 4) float64. ``stamp`` is in seconds. ``color`` is (H, W, 3) uint8 RGB of the same pixels, 0 0 0
    where a pixel has none, or None. ``images`` are others of the same pixels, by the names that layers of
    voxels have for them (voxels/layers.py), uint8. ``name`` is what error messages and reports call this
    frame.

    The other fields are None if the sensor's configuration holds for the frame: ``sigma_m``, (H, W) float32,
    the standard deviation in metres of each pixel's depth; ``noise``, a noise model for this frame;
    ``no_return``, the pixels without a return (own_evidence.NoReturn); ``origin_m``, where the world's origin
    lies in the recorded world if it was moved (Dataset.origin_m). ``sensor`` names the sensor in a recording
    of several. ``gyro`` holds the camera's angular rates since the previous frame or longer,
    ``acceleration`` its accelerations since the last but one.
    """

    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: Camera
    stamp: float
    name: str
    color: NDArray[np.uint8] | None = None
    sigma_m: NDArray[np.float32] | None = None
    noise: "NoiseModel | None" = None
    no_return: NoReturn | None = None
    sensor: str = ""
    gyro: "GyroSamples | None" = None
    acceleration: "AccelerationSamples | None" = None
    origin_m: tuple[float, ...] | None = None
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)

    @property
    def points_m(self) -> NDArray[np.float64]:
        """The points of its pixels in the camera frame, (H, W, 3) metres; those without a depth lie where
        their ray starts."""
        return points_at(self.camera, self.depth_m)

    @property
    def own(self) -> OwnEvidence:
        """The frame's own noise, sigma and missing returns, as recorded."""
        return OwnEvidence(self.noise, self.sigma_m, self.no_return)

    def own_for(self, sensor: SensorConfig) -> OwnEvidence:
        """The part of :attr:`own` that a map with this configuration uses."""
        sigma_m = self._widened_sigma(sensor) if sensor.pixel_sigma else None
        counts = sensor.no_return != "ignore"
        no_return = checked_no_return(self.no_return, self.depth_m, self.camera, counts)
        noise = None if self.noise is None else widened_noise(self.noise, sensor)
        return OwnEvidence(noise, sigma_m, no_return)

    def own_in(self, config: Config) -> OwnEvidence:
        """:meth:`own_for` this configuration, with the covariance of the frame's pose."""
        poses = config.poses
        covariance = checked_covariance(covariance_of(poses.doubt_translation, poses.doubt_rotation))
        return replace(self.own_for(config.sensor), pose_covariance=covariance)

    def tells_anything(self, sensor: SensorConfig) -> bool:
        """True if it holds a measurement, or a pixel without a return that such a map uses."""
        missing = self.own_for(sensor).no_return
        return bool((self.depth_m > 0).any() or (missing is not None and missing.any()))

    def _widened_sigma(self, sensor: SensorConfig) -> NDArray[np.float32] | None:
        """The sigma of each pixel with the configuration's ``sigma_scale`` and ``sigma_added``."""
        stated = self.sigma_m
        if stated is None or (sensor.sigma_scale == 1 and sensor.sigma_added == 0):
            return stated
        wider = np.float32(sensor.sigma_scale) * stated + np.float32(sensor.sigma_added)
        return np.where(stated > 0, wider, stated)
