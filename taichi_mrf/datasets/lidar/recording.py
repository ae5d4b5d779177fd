"""What every recording of a lidar says of its sensor, whatever its format."""

import warnings
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.base import Dataset, StatedSensor
from taichi_mrf.errors import DatasetError, FrameError

LIDAR_SIGMA_M = 0.03
"""Standard deviation of range that is assumed: spinning lidars are specified with 2 to 3 cm at all ranges."""

LIDAR_PASS_THROUGH = 0.1
"""Chance that a beam passes an occupied voxel. A lidar's voxels are wide, so posts and legs fill only a part
of one (docs/decisions.md)."""

_REACH_STEP_M, MOST_REACH_M = 10.0, 500.0


@dataclass
class LidarRecording(Dataset):
    """The scans of a lidar. ``reach_m`` is the largest range of the first one, None until that is read."""

    reach_m: float | None = field(default=None, kw_only=True)

    def look_at_first(self, what: str) -> None:
        """Set camera and reach from the first scan (``what``) that can be read. Raises DatasetError, which
        says why the first cannot, if none can."""
        problem: FrameError | None = None
        for index in range(len(self)):
            try:
                frame = self.read(index)
            except FrameError as error:
                problem = problem or error
                continue
            self.camera, self.reach_m = frame.camera, reach_of(frame.depth_m)
            return
        raise DatasetError(f"{self.name}: no {what} can be read: {problem}") from problem

    @property
    def stated(self) -> StatedSensor:
        """What is assumed for every lidar, and the largest range of the first scan."""
        return StatedSensor(
            (LIDAR_SIGMA_M,),
            origin="assumed for a lidar",
            reach_m=self.reach_m,
            pass_through=LIDAR_PASS_THROUGH,
        )


def reach_of(range_m: NDArray[np.floating]) -> float:
    """How far ranges, 0 for none, go: all but the thousandth of them that may be damaged, rounded up to tens
    of metres, and at most MOST_REACH_M. Warns if most go further."""
    median_m = float(np.median(range_m[range_m > 0]))
    if median_m > MOST_REACH_M:
        warnings.warn(
            f"half of the points of the first scan are further than {median_m:.0f} m: points are read as "
            "metres, so divide them by 1000 if they are millimetres; else set sensor.max_depth",
            stacklevel=3,
        )
    reach_m = np.quantile(range_m[range_m > 0], 0.999)
    return float(min(max(1.0, np.ceil(reach_m / _REACH_STEP_M)) * _REACH_STEP_M, MOST_REACH_M))
