"""The ways in which a recording may be understood: those that are usually mistaken for each other."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.turned import stored_camera
from taichi_mrf.sensor.camera import PinholeCamera

UNITS = {
    1000.0: "millimetres",
    5000.0: "TUM RGB-D's, ICL-NUIM's",
    4000.0: "RealSense's and ScanNet's finer one",
    6553.5: "Replica's",
    10000.0: "tenths of a millimetre",
    256.0: "KITTI's",
    100.0: "centimetres",
    1.0: "metres",
    1 / 0.3048: "feet",
}
"""Steps per metre of depth, and whose they are."""


def _resized(factor: float) -> Callable[[PinholeCamera], PinholeCamera]:
    return lambda k: replace(
        k, fx=k.fx * factor, fy=k.fy * factor, cx=(k.cx + 0.5) * factor - 0.5, cy=(k.cy + 0.5) * factor - 0.5
    )


LENSES: dict[str, Callable[[PinholeCamera], PinholeCamera]] = {
    "are of images of half the size": _resized(2.0),
    "are of images of twice the size": _resized(0.5),
    "are of images of two thirds of the size": _resized(1.5),
    "are of images of one and a half times the size": _resized(2 / 3),
    "are of images of a third of the size": _resized(3.0),
    "are of images of three times the size": _resized(1 / 3),
    "have cx and cy swapped": lambda k: replace(k, cx=k.cy, cy=k.cx),
    "have fx and fy swapped": lambda k: replace(k, fx=k.fy, fy=k.fx),
    "have x and y swapped": lambda k: replace(k, fx=k.fy, fy=k.fx, cx=k.cy, cy=k.cx),
}
"""Faults of intrinsics, and the camera that they should be."""


@dataclass(frozen=True)
class Reading(Conventions):
    """One way to understand a recording: its conventions, and what its unit and its intrinsics should be."""

    factor: float = 1.0
    """Factor by which depths as they are read must be multiplied."""

    lens: str = ""
    """A key of LENSES; empty if the intrinsics are right."""

    focal: float = 1.0
    """Factor by which focal lengths must be multiplied."""

    camera: PinholeCamera | None = None
    """The camera of all images of its size, where intrinsics change that should not; None for each one's."""

    def camera_of(self, recorded: PinholeCamera) -> PinholeCamera:
        """The camera that took the images."""
        if self.camera is not None and self.camera.shape == recorded.shape:
            recorded = self.camera
        camera = LENSES[self.lens](recorded) if self.lens else recorded
        return replace(camera, fx=camera.fx * self.focal, fy=camera.fy * self.focal)

    def stored_camera(self, recorded: PinholeCamera) -> PinholeCamera:
        """The camera of the images as they are stored."""
        return _stored(self.of_camera, recorded)

    @property
    def of_camera(self) -> "Reading":
        """The part that concerns the camera alone."""
        return Reading(
            along_ray=self.along_ray, turned=self.turned, lens=self.lens, focal=self.focal, camera=self.camera
        )

    @property
    def of_poses_alone(self) -> "Reading":
        """The part that concerns poses, at their own times."""
        return replace(
            self, late_s=0.0, along_ray=False, turned="", factor=1.0, lens="", focal=1.0, camera=None
        )


@cache
def _stored(reading: Reading, recorded: PinholeCamera) -> PinholeCamera:
    """The camera of stored images: a search asks for few, and tens of thousands of times."""
    return stored_camera(reading.camera_of(recorded), reading.turned)
