"""The range that a recording's depths call for, and the sigma that it brings."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from console import carry_out
from sliding_camera import CAMERA, SlidingCamera
from stereo_rig import BASELINE, write_kitti

from taichi_mrf.config.schema import Config, SensorConfig, load
from taichi_mrf.config.sections import LEAST_FLOOR, InferenceConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import StatedSensor
from taichi_mrf.datasets.recorded_noise import (
    SHORT_RAYS_FLOOR,
    proposed_voxel_size,
    with_recorded_noise,
    with_tuned_noise,
)
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.frame import Frame


@dataclass
class Street(SlidingCamera):
    """A street by a stereo rig: a ``share`` of the pixels sees what is up to ``far_m`` away."""

    far_m: float = 100.0
    share: float = 0.5
    lambda_: float = 7.5e-4

    @property
    def stated(self) -> StatedSensor:
        return StatedSensor((0.0, 0.0, self.lambda_))

    def read(self, index: int) -> Frame:
        frame = super().read(index)
        far = np.linspace(0, 1, frame.depth_m.size).reshape(frame.depth_m.shape) < self.share
        return replace(frame, depth_m=np.where(far, np.float32(self.far_m), frame.depth_m))


def street(**parameters: float) -> Street:
    return Street("street", CAMERA, **parameters)


@pytest.mark.parametrize(
    ("parameters", "reach_m"),
    [
        ({}, 40.0),  # 3% of 40 m
        ({"far_m": 25.0}, 25.0),
        ({"far_m": 9.0}, 10.0),
        ({"share": 0.05}, 10.0),
        ({"lambda_": 0.01}, 10.0),
    ],
)
def test_the_range_follows_the_depths_as_far_as_sigma_is_useful(
    parameters: dict[str, float], reach_m: float
) -> None:
    dataset = street(**parameters)
    assert with_recorded_noise(Config(), dataset).sensor.max_depth == reach_m
    said = [note for note in dataset.notes if note.startswith("sensor.max_depth is")]
    assert len(said) == (reach_m != 10.0)


def test_a_range_that_was_set_stays_and_the_flag_is_named() -> None:
    near, dataset = Config(sensor=SensorConfig(max_depth=8.0)), street()
    assert with_recorded_noise(near, dataset).sensor.max_depth == 8.0
    assert dataset.notes[-1].startswith("50% of the measurements lie beyond sensor.max_depth, 8 m")
    assert "--sensor.max-depth 40 uses those" in dataset.notes[-1]
    few, right = street(share=0.05), street()
    with_recorded_noise(near, few)
    with_recorded_noise(with_recorded_noise(Config(), right), right)
    assert not any("lie beyond" in note for note in few.notes + right.notes)


def test_a_broken_frame_does_not_count() -> None:
    dataset = street(count=3)
    dataset.broken = [0, 1, 2]
    assert with_recorded_noise(Config(), dataset).sensor.max_depth == 10.0


def test_the_shipped_sigma_of_a_stereo_rig_gives_way_to_the_recordings_own(tmp_path: Path) -> None:
    dataset = open_dataset(write_kitti(tmp_path))
    shipped = load("stereo")
    applied = with_recorded_noise(shipped, dataset).sensor
    assert applied.pixel_sigma
    assert applied.sigma == pytest.approx((0.0, 0.0, SIGMA_D_PX / (BASELINE * 100)))
    assert (applied.min_depth, applied.max_depth) == (shipped.sensor.min_depth, shipped.sensor.max_depth)


def test_outliers_are_dense_only_where_rays_are_short() -> None:
    room, hall = street(far_m=3.0, share=1.0), street(far_m=9.0, share=1.0)
    assert with_recorded_noise(Config(), room).inference.outlier_floor == SHORT_RAYS_FLOOR
    assert with_recorded_noise(Config(), hall).inference.floor == LEAST_FLOOR
    assert with_recorded_noise(Config(), street()).inference.floor == LEAST_FLOOR
    few = replace(Config(), inference=InferenceConfig(surface_density=0.5))
    assert with_recorded_noise(few, hall).inference.outlier_floor == SHORT_RAYS_FLOOR
    stated = replace(Config(), inference=InferenceConfig(outlier_floor=1e-4))
    assert with_recorded_noise(stated, room).inference == stated.inference
    assert with_tuned_noise(Config(), hall).inference.outlier_floor == LEAST_FLOOR


@pytest.mark.parametrize("filling_m", [1e10, 65.535, 10.0])
def test_a_number_for_what_was_not_seen_is_no_measurement_or_is_said(
    filling_m: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true_m = np.random.default_rng(0).uniform(1, 4, (4, 12, 16)).astype(np.float32)
    depth_m = true_m.copy()
    depth_m[:, :3] = filling_m
    camera = {"K": np.array([[14.0, 0, 7.5], [0, 14, 5.5], [0, 0, 1]])}
    np.savez(tmp_path / "walk.npz", depth_m=depth_m, T_world_camera=np.stack([np.eye(4)] * 4), **camera)
    dataset = open_dataset(tmp_path / "walk.npz")
    read_m = dataset.read(1).depth_m
    np.testing.assert_array_equal(read_m[3:], true_m[1, 3:])
    np.testing.assert_array_equal(read_m[:3], filling_m if filling_m == 10 else 0)
    settings = with_recorded_noise(Config(), dataset)
    assert settings.sensor.max_depth <= 10
    told = [note for note in dataset.notes if "exactly 10 m" in note]
    assert len(told) == (filling_m == 10)
    assert not told or told[0].startswith("depth: 25% of the measurements")
    for flags in ([], ["--json"]):
        assert carry_out("info", tmp_path / "walk.npz", *flags) == 0
        assert ("exactly 10 m" in capsys.readouterr().out) == (filling_m == 10)


def test_no_range_is_sought_without_bound() -> None:
    endless_m = Street("street", CAMERA, far_m=1e10)
    assert with_recorded_noise(Config(), endless_m).sensor.max_depth < 10_000


@pytest.mark.parametrize(
    ("median_m", "sigma_m", "size_m"),
    [
        (3.0, 0.0, 0.05),  # a room
        (5.0, 0.0, 0.05),  # 1% of the depth
        (6.2, 0.03, 0.1),  # a building by lidar
        (13.3, 0.13, 0.2),  # a street by stereo
        (13.3, 0.25, 0.5),
        (40.0, 3.0, 5.0),
        (0.3, 0.0, 0.02),  # things on a table: 10% of the depth
        (0.3, 0.2, 0.02),
    ],
)
def test_without_a_size_voxels_fit_depths_and_noise(median_m: float, sigma_m: float, size_m: float) -> None:
    dataset = street(far_m=median_m, share=1.0, lambda_=sigma_m / median_m**2)
    unset = replace(Config(), fit_voxel_size=True)
    fitted = with_recorded_noise(unset, dataset)
    assert (fitted.voxel_size, fitted.fit_voxel_size) == (size_m, False)
    assert proposed_voxel_size(dataset) == size_m
    said = [note for note in dataset.notes if note.startswith("voxel_size is")]
    assert len(said) == (size_m != 0.05)
    assert with_recorded_noise(Config(), street(far_m=median_m, share=1.0)).voxel_size == 0.05


def test_without_depths_voxels_are_the_default() -> None:
    blind = street()
    blind.broken = range(blind.count)
    fitted = with_recorded_noise(replace(Config(), fit_voxel_size=True), blind)
    assert (fitted.voxel_size, fitted.fit_voxel_size) == (0.05, False)
    assert with_recorded_noise(Config(5.0), blind).voxel_size == 5.0


def test_voxels_larger_than_half_the_median_depth_are_a_slip() -> None:
    room = street(far_m=3.0, share=1.0)
    assert with_recorded_noise(Config(1.5), room).voxel_size == 1.5
    with pytest.raises(
        ConfigError, match=r"voxel_size is 5 m, .* 3 m: was 5cm meant\? --voxel-size 5cm fits"
    ):
        with_recorded_noise(Config(5.0), room)
    with pytest.raises(ConfigError, match=r"was 50mm meant\? --voxel-size 5cm fits"):
        with_recorded_noise(Config(50.0), room)
