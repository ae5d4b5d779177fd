"""Several sensors in one recording: order, noise, extrinsics, ranges, and what is wrong with the file."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets_recordings import Content, arrays, write_npz, write_stray
from point_clouds import Walk, write_scans
from refusals import bad_frame, refused

from taichi_mrf.cluster.submaps.plan import SourceFrames
from taichi_mrf.cluster.submaps.survey import find_keyframes
from taichi_mrf.config.schema import Config, KeyframeConfig, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.lidar.scans import LIDAR_SIGMA_M
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.several_sensors import SeveralSensors
from taichi_mrf.errors import DatasetError
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import FrameOffered, map_sequence
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system import runtime

TEXT = """
sensors:
  - name: depth
    source: depth.npz
    max_depth: 3.0
    reading: {image_scale: 0.5}
  - name: lidar
    source: scans
    sigma: [0.02, 0.001]
    every: 2
    T_poses_sensor: [1, 0, 0, 0.5,  0, 1, 0, 0,  0, 0, 1, 0.25]
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """Five depth images at 5.5, 5.7, ... s and scans at 5, 6, 7 s, of which every second is taken."""
    content = Content()
    write_npz(tmp_path / "depth.npz", arrays(content) | {"stamp": 5.5 + 0.2 * np.arange(content.count)})
    write_scans(tmp_path / "scans", Walk())
    (tmp_path / "robot.yaml").write_text(TEXT)
    return tmp_path / "robot.yaml"


def test_frames_come_in_the_order_of_their_stamps(robot: Path) -> None:
    dataset = open_dataset(robot)
    assert isinstance(dataset, SeveralSensors)
    frames = list(dataset)
    assert [frame.stamp for frame in frames] == pytest.approx([5.0, 5.5, 5.7, 5.9, 6.1, 6.3, 7.0])
    assert [frame.sensor for frame in frames] == ["lidar", *["depth"] * 5, "lidar"]
    assert [frame.name for frame in frames] == list(dataset.frame_names)
    assert dataset.frame_names[:2] == ["lidar-scan-000", "depth-depth-000000"]
    assert [dataset.sensor_of(i) for i in (0, 1)] == ["lidar", "depth"]
    np.testing.assert_allclose(dataset.stamps(), [frame.stamp for frame in frames])


def test_each_sensor_has_its_own_noise_range_and_place(robot: Path) -> None:
    lidar, depth = open_dataset(robot).read(0), open_dataset(robot).read(1)
    assert isinstance(lidar.noise, PolynomialNoise)
    np.testing.assert_allclose(lidar.noise.sigma[0, :2], [0.02, 0.001])
    np.testing.assert_allclose(lidar.T_world_camera[:3, 3], (Walk().poses[0] @ [0.5, 0, 0.25, 1])[:3])
    assert depth.noise is None, "the configuration's"
    assert isinstance(depth.camera, PinholeCamera)
    assert depth.camera.shape == (6, 8)
    alone = open_dataset(robot.parent / "depth.npz", image_scale=0.5).read(0)
    assert (alone.depth_m > 3.0).any()
    np.testing.assert_array_equal(depth.depth_m, np.where(alone.depth_m <= 3.0, alone.depth_m, 0))


@pytest.mark.parametrize("given", [False, True])
def test_a_sigma_in_the_file_holds_for_all_pixels(tmp_path: Path, given: bool) -> None:
    write_stray(tmp_path / "phone", Content(1))
    (tmp_path / "robot.yaml").write_text(
        "sensors: [{source: phone" + (", sigma: [0.03]" if given else "") + "}]"
    )
    frame = open_dataset(tmp_path / "robot.yaml").read(0)
    assert (frame.sigma_m is None) == given
    assert isinstance(frame.noise, PolynomialNoise)
    assert frame.noise.sigma[0, 0] == (0.03 if given else 0.01)


def test_a_lidars_sigma_and_reach_are_the_defaults(robot: Path) -> None:
    robot.write_text("sensors: [{source: scans}, {source: depth.npz, min_depth: 1.0, max_depth: 40.0}]")
    dataset = open_dataset(robot)
    lidar, depth = dataset.read(0), dataset.read(1)
    assert (lidar.sensor, depth.sensor) == ("sensor-1", "sensor-2")
    assert isinstance(lidar.noise, PolynomialNoise)
    assert lidar.noise.sigma[0, 0] == LIDAR_SIGMA_M
    assert depth.depth_m[depth.depth_m > 0].min() >= 1.0
    assert with_recorded_noise(Config(), dataset).sensor == SensorConfig(max_depth=40.0)


@pytest.mark.usefixtures("one_backend")
def test_keyframes_are_chosen_for_each_sensor(robot: Path) -> None:
    """The lidar's first scan does not stand in for the camera's first image."""
    config = Config(voxel_size=0.5, keyframes=KeyframeConfig(translation=100.0))
    added = []

    def listen(event: object) -> None:
        if isinstance(event, FrameOffered) and isinstance(event.answer, Added):
            added.append(event.name)

    dataset = open_dataset(robot)
    m = map_sequence(dataset, config, listen).map
    assert added == ["lidar-scan-000", "depth-depth-000000"]
    assert [keyframe.camera.shape for keyframe in m.keyframes.values()] == [
        dataset.read(0).camera.shape,
        (6, 8),
    ]


class InTurn:
    """Runs tasks one after the other, in this process."""

    def run(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], done: Callable[..., None]
    ) -> list[Any]:
        return [function(task) for task in tasks]


@pytest.mark.usefixtures("one_backend")
def test_submaps_choose_keyframes_for_each_sensor_too(robot: Path) -> None:
    config = Config(voxel_size=0.5, keyframes=KeyframeConfig(translation=100.0))
    active = runtime.active()
    assert active is not None
    config = replace(config, runtime=replace(config.runtime, arch=active))
    keyframes, _ = find_keyframes(SourceFrames(str(robot), {}), config, InTurn())  # type: ignore[arg-type]
    assert [keyframe.index for keyframe in keyframes] == [0, 1]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("sensors: []", "lists no sensor"),
        ("sensors: 3", "sensors must be a list"),
        ("sensors: [{name: a}]", "source missing"),
        ("sensors: [{source: scans, rate: 3}]", "unknown parameter 'rate'"),
        ("sensors: [{source: scans, every: 0}]", "every must be at least 1"),
        ("sensors: [{source: scans, min_depth: 4, max_depth: 3}]", "max_depth must be more than min_depth"),
        ("sensors: [{source: scans, T_poses_sensor: [1, 2]}]", "T_poses_sensor must have 12 or 16 numbers"),
        ("sensors: [{source: nowhere}]", "sensor-1: .*nowhere: no such folder or file"),
        ("sensors: [{source: scans, reading: {image_scale: 0.5}}]", "sensor-1: .*--image-scale"),
        ("sensors: [{source: scans, name: a}, {source: scans, name: a}]", "two sensors have one name"),
        ("sensors: [{source: scans, T_poses_sensor: [2,0,0,0, 0,2,0,0, 0,0,2,0]}]", "sensor-1: the rotation"),
    ],
)
def test_what_is_wrong_with_the_file_is_named(robot: Path, text: str, problem: str) -> None:
    robot.write_text(text)
    refused(robot, str(robot), *problem.split(".*"))


def test_options_belong_to_the_sensors(robot: Path) -> None:
    refused(robot, str(robot), "reading: {...}", image_scale=0.5)
    refused(robot, str(robot), "cannot be found by tracking", track=True)


def test_a_broken_frame_is_named_by_its_sensor(robot: Path) -> None:
    np.savez(robot.parent / "scans" / "scan-000.npz", xyz=np.zeros((2, 3)))
    dataset = open_dataset(robot)
    bad_frame(dataset, 0, "scan-000.npz: none of 2 points")
    assert dataset.read(6).sensor == "lidar"


@pytest.mark.parametrize("source", ["robot.yaml", "other.yaml"])
def test_a_file_lists_no_file_of_several_sensors(robot: Path, source: str) -> None:
    """It could name itself, or files that name each other, or grow without end."""
    other = robot.with_name("other.yaml")
    other.write_text(robot.read_text())
    ring = f"sensors: [{{source: {source}}}, {{source: {source}}}]"
    robot.write_text(ring)
    with pytest.raises(DatasetError, match=r"lists several sensors, as .*robot\.yaml does: list all of them"):
        open_dataset(robot)
    assert len(open_dataset(other)) == 7, "what was refused changes nothing"
