"""Several sensors as one recording, described by a YAML file: ``taichi-mrf map robot.yaml``.

::

    sensors:
      - name: depth
        source: walk.mcap?depth=/camera/depth/image_raw     # relative to this file
        max_depth: 4.0
        reading: {image_scale: 0.5}
      - name: lidar
        source: walk.mcap?points=/points
        sigma: [0.02]

The fields of :class:`SensorEntry` are those of a sensor. Frames come in the order of their stamps, which all
sensors must count from one beginning, at poses in one world. Each frame states the noise of its sensor.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from taichi_mrf.config.files import read_yaml
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.config.values import check_field, from_dict
from taichi_mrf.datasets.base import Dataset, Row, StatedSensor, Table
from taichi_mrf.datasets.options import ReadOptions
from taichi_mrf.datasets.own_body import NO_BODY
from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError, DatasetError, FrameError, KeyframeError, naming
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise

_SOURCE = re.compile(r"[a-z][a-z0-9_]+:")


@dataclass(frozen=True)
class SensorEntry:
    """One sensor of the file."""

    source: str
    """Its recording, as ``taichi-mrf map`` takes it; a path is relative to the file."""

    name: str = ""
    """Beginning of its frames' names; sensor-1, sensor-2, ... by default."""

    sigma: tuple[float, ...] | None = None
    """Standard deviation of its depth in metres, coefficients in ascending powers of depth, for all pixels.
    By default the recording's own, which may be one for each pixel, or the configuration's."""

    bias: tuple[float, ...] = (0.0,)
    """Mean of measured minus true depth, likewise."""

    min_depth: float = 0.0
    """Nearer measurements are left out (metres)."""

    max_depth: float | None = None
    """Farther measurements are left out (metres). By default what a lidar reaches, else 10 m."""

    every: int = 1
    """Take every n-th frame."""

    T_poses_sensor: tuple[float, ...] = ()
    """The sensor in the frame that the recording's poses are of: the 12 or 16 numbers of a matrix, row by
    row."""

    reading: SourceFlags = field(default_factory=SourceFlags)
    """Options for reading the source, named as the command line's flags, such as depth_scale and mask, whose
    path is relative to the file."""

    def __post_init__(self) -> None:
        check_field(self.every >= 1, "every", "must be at least 1")
        check_field(self.min_depth >= 0, "min_depth", "must not be negative")
        far_enough = self.max_depth is None or self.max_depth > self.min_depth
        check_field(far_enough, "max_depth", "must be more than min_depth")
        check_field(len(self.T_poses_sensor) in (0, 12, 16), "T_poses_sensor", "must have 12 or 16 numbers")


@dataclass(frozen=True)
class SensorsFile:
    """The content of the file."""

    sensors: tuple[SensorEntry, ...]


@dataclass(frozen=True)
class RecordedSensor:
    """A sensor and its recording. ``noise`` is None for the configuration's; if it is ``given`` in the file,
    it is that of all pixels."""

    name: str
    dataset: Dataset
    noise: PolynomialNoise | None
    given: bool
    T_poses_sensor: Pose
    range_m: tuple[float, float]


@dataclass(frozen=True)
class SensorFrame(Row):
    """A frame of a sensor, and its index there."""

    taken_by: RecordedSensor
    index: int


@dataclass
class SeveralSensors(Table[SensorFrame]):
    """The frames of several sensors in the order of their stamps; ``camera`` is the first sensor's."""

    sensors: Sequence[RecordedSensor] = field(kw_only=True)

    @property
    def stated(self) -> StatedSensor:
        """The reach of the sensor that reaches farthest."""
        return StatedSensor(reach_m=max(sensor.range_m[1] for sensor in self.sensors))

    def sensor_of(self, index: int) -> str:
        return self.rows[index].taken_by.name

    def load(self, index: int, row: SensorFrame, T_world_camera: Pose) -> Frame:
        sensor = row.taken_by
        with naming(sensor.name, FrameError):
            frame = sensor.dataset.read(row.index)
        least, most = sensor.range_m
        inside = (frame.depth_m >= least) & (frame.depth_m <= most)
        return replace(
            frame,
            depth_m=np.where(inside, frame.depth_m, np.float32(0)),
            T_world_camera=frame.T_world_camera @ sensor.T_poses_sensor,
            name=row.name,
            noise=frame.noise or sensor.noise,
            sigma_m=None if sensor.given else frame.sigma_m,
            sensor=sensor.name,
        )


def open_file(path: Path, options: ReadOptions) -> SeveralSensors:
    """Open the recordings of all sensors. Raises DatasetError, which names the file and the sensor."""
    _refuse(path, options)
    if _opening:
        raise DatasetError(f"{path}: lists several sensors, as {_opening[0]} does: list all of them there")
    with naming("", ConfigError):
        described = from_dict(SensorsFile, read_yaml(path), str(path))
    if not described.sensors:
        raise DatasetError(f"{path}: lists no sensor")
    names = [entry.name or f"sensor-{number}" for number, entry in enumerate(described.sensors, start=1)]
    if len(set(names)) < len(names):
        raise DatasetError(f"{path}: two sensors have one name; the names are {', '.join(names)}")
    sensors, rows = [], []
    for entry, name in zip(described.sensors, names, strict=True):
        _opening.append(path)
        try:
            with naming(f"{path}: {name}", ConfigError, DatasetError, KeyframeError):
                sensor = _open_sensor(path, entry, name, options)
        finally:
            _opening.clear()
        stamps, frame_names = sensor.dataset.stamps(), sensor.dataset.frame_names
        for i in range(0, len(sensor.dataset), entry.every):
            pose = partial(_pose, sensor, i)
            rows.append(
                SensorFrame(f"{name}-{frame_names[i]}", float(stamps[i]), pose, sensor.name, sensor, i)
            )
        sensors.append(sensor)
    return SeveralSensors(
        path.stem,
        sensors[0].dataset.camera,
        [f"{sensor.name}: {note}" for sensor in sensors for note in sensor.dataset.notes],
        sum(sensor.dataset.dropped for sensor in sensors),
        sensors=sensors,
        rows=sorted(rows, key=lambda row: row.stamp),
    )


_opening: list[Path] = []
"""The file whose sensors are being opened: one that lists another could name itself, or grow without end."""


def _pose(sensor: RecordedSensor, index: int) -> Pose:
    with naming(sensor.name, FrameError):
        return sensor.dataset.pose(index) @ sensor.T_poses_sensor


def _open_sensor(path: Path, entry: SensorEntry, name: str, options: ReadOptions) -> RecordedSensor:
    source = entry.source
    if not Path(source).is_absolute() and not _SOURCE.match(source):
        source = str(path.parent / source)
    keywords = entry.reading.within(path.parent).keywords()
    if keywords["max_time_gap"] is None:
        keywords["max_time_gap"] = options.max_time_gap
    dataset = open_dataset(source, color=options.color, **keywords)
    if dataset.endless or dataset.tracked:
        raise DatasetError("only recordings with poses can be put together")
    sigma = entry.sigma or dataset.stated.sigma
    most = entry.max_depth or dataset.stated.reach_m or SensorConfig().max_depth
    T = as_pose(np.reshape(entry.T_poses_sensor, (-1, 4))) if entry.T_poses_sensor else np.eye(4)
    noise = None if sigma is None else PolynomialNoise(sigma, entry.bias)
    return RecordedSensor(name, dataset, noise, entry.sigma is not None, T, (entry.min_depth, most))


def _refuse(path: Path, options: ReadOptions) -> None:
    """Raise DatasetError for options that each sensor has its own of."""
    own = (options.camera, options.intrinsics, options.depth_scale, options.undistort)
    if any(value is not None for value in own) or options.image_scale != 1.0 or options.body != NO_BODY:
        raise DatasetError(f"{path}: lists several sensors; set how each is read there, as reading: {{...}}")
    if options.track:
        raise DatasetError(f"{path}: lists several sensors, whose poses cannot be found by tracking")
