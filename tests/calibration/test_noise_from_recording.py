"""Sigma that is learnt from the recording itself, against simulated noise of a known sigma."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from plugged_noise import PixelNoise, SquareNoise

from taichi_mrf import open_dataset
from taichi_mrf.calibration import from_recording
from taichi_mrf.calibration.from_recording import (
    FRAMES,
    LONGEST_STRIDE,
    RUNS,
    _priors,
    _spread,
    learn_sigma,
    sigma_of_glance,
)
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.derived import Derived, chosen
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.evaluation.noise_fit import (
    CONTRADICTED,
    VOXEL_SPREAD,
    NoiseCheck,
    SigmaLaw,
    check_noise,
    enough_of,
)
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import NoiseModel, PolynomialNoise
from taichi_mrf.sensor.stored import stored_arrays
from taichi_mrf.session.noise import noise_notes
from taichi_mrf.system.atomic import write_npz

VOXEL = 0.05

CLOSE = 1.5
"""Factor to which sigma is found."""


class Noisy(Derived):
    """A recording whose measurements are off by 10 cm more than its source's."""

    def read(self, index: int) -> Frame:
        frame = self.source.read(index)
        off_m = np.random.default_rng(index).normal(0.0, 0.1, frame.depth_m.shape)
        noisy_m = np.where(frame.depth_m > 0, np.maximum(frame.depth_m + off_m, 0.1), 0.0)
        return replace(frame, depth_m=noisy_m.astype(np.float32))


@pytest.fixture(scope="module")
def room() -> Dataset:
    """With the noise of a Kinect 1, which is the default."""
    return open_dataset("synthetic:room?frames=12&width=160&height=120", color=False)


def learnt_m(room: Dataset, sensor: SensorConfig, depth_m: float) -> float:
    """Sigma at a depth as it is learnt by a user who states another one."""
    found = learn_sigma(room, Config(VOXEL, sensor=sensor))
    assert found.after >= found.before
    stated_m = float(np.polynomial.polynomial.polyval(depth_m, sensor.sigma))
    return found.law.scale * stated_m + found.law.added_m


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_the_true_sigma_is_learnt_whatever_is_stated(room: Dataset, factor: float) -> None:
    depths = np.concatenate([f.depth_m[f.depth_m > 0] for f in (room.read(i) for i in range(len(room)))])
    depth_m = float(np.median(depths))
    right = SensorConfig().sigma
    true_m = float(np.polynomial.polynomial.polyval(depth_m, right))
    found_m = learnt_m(room, SensorConfig(sigma=tuple(factor * c for c in right)), depth_m)
    # What a part of a voxel explains is left to it, which may be all or nothing.
    voxel_m = VOXEL_SPREAD * VOXEL
    assert true_m / CLOSE < math.hypot(found_m, voxel_m)
    assert found_m < CLOSE * math.hypot(true_m, voxel_m)
    assert abs(math.log(found_m / true_m)) < abs(math.log(factor))


@pytest.mark.usefixtures("one_backend")
def test_a_noise_that_held_out_frames_agree_with_stays(room: Dataset) -> None:
    found = learn_sigma(room, Config(VOXEL))
    assert found.law == SigmaLaw(1.0, 0.0)
    assert found.before == found.after


@pytest.mark.usefixtures("one_backend")
def test_a_prior_for_long_rays_is_tried_only_where_rays_are_long(room: Dataset) -> None:
    assert _priors(room, Config(VOXEL)) == []
    rays = np.concatenate([f.depth_m[f.depth_m > 0] for f in (room.read(i) for i in range(len(room)))])
    dense = replace(Config(VOXEL), inference=InferenceConfig(surface_density=20.0))
    few, wild = _priors(room, dense)
    assert few["surface_density"] == pytest.approx(1.0 / rays.mean(), rel=1e-3)
    assert wild == few | {"outlier_floor": 1e-2}
    assert _priors(room, replace(dense, inference=InferenceConfig(surface_density=20.0, prior=0.1))) == []
    assert _priors(room, replace(dense, method="log_odds")) == []


def test_a_long_recording_is_sampled_in_runs() -> None:
    assert _spread(range(0, 10, 2)) == [0, 2, 4, 6, 8]
    picked = _spread(range(5000))
    assert len(picked) == FRAMES
    steps = np.diff(picked)
    assert (steps > 0).all()
    assert (steps == LONGEST_STRIDE).sum() == FRAMES - RUNS
    assert picked[0] == 0
    assert picked[-1] >= 5000 - 2 * LONGEST_STRIDE


@pytest.mark.usefixtures("one_backend")
def test_chosen_frames_are_those_of_the_source(room: Dataset) -> None:
    some = chosen(room, [7, 2])
    assert list(some.frame_names) == [room.frame_names[7], room.frame_names[2]]
    np.testing.assert_array_equal(some.read(1).depth_m, room.read(2).depth_m)
    assert list(some.stamps()) == [room.read(7).stamp, room.read(2).stamp]


@pytest.mark.usefixtures("one_backend")
def test_recordings_that_cannot_tell_are_refused(room: Dataset) -> None:
    class Tracked(type(chosen(room, [0]))):  # type: ignore[misc]
        pass

    tracked = Tracked("walk", room.camera, tracked=True, source=room, indices=[0, 1, 2, 3])
    with pytest.raises(ConfigError, match="needs a recording with poses"):
        learn_sigma(tracked, Config(VOXEL))

    class Camera(Tracked):
        endless = True

    camera = Camera("realsense:", room.camera, tracked=True, source=room, indices=[])
    with pytest.raises(ConfigError, match="recording, and realsense: is a live camera: record it"):
        learn_sigma(camera, Config(VOXEL))
    with pytest.raises(DatasetError, match="0 held-out frames"):
        learn_sigma(chosen(room, [0, 1]), Config(VOXEL))


@dataclass
class Stating(Derived):
    """A recording whose frames state a noise."""

    noise: NoiseModel = field(kw_only=True)

    def read(self, index: int) -> Frame:
        return replace(self.source.read(index), noise=self.noise)


@pytest.mark.usefixtures("one_backend")
def test_a_file_of_a_class_is_learnt_as_one_of_the_same_polynomial(room: Dataset, tmp_path: Path) -> None:
    least_m, growth = 2.0**-9, 2.0**-13  # too small; as float32 the same
    found = []
    for noise in (SquareNoise(least_m, growth), PolynomialNoise((least_m, 0.0, growth))):
        write_npz(tmp_path / "noise.npz", stored_arrays(noise))
        sensor = SensorConfig(sigma_table=str(tmp_path / "noise.npz"))
        found.append(learn_sigma(room, Config(VOXEL, sensor=sensor)))
    of_class, of_values = found
    assert of_class.factor > CONTRADICTED
    assert of_class.law != SigmaLaw(1.0, 0.0)
    for name in ("factor", "before", "after"):
        assert getattr(of_class, name) == pytest.approx(getattr(of_values, name), rel=1e-6)
    assert of_class.law.scale == pytest.approx(of_values.law.scale, rel=1e-6)
    assert of_class.law.added_m == pytest.approx(of_values.law.added_m, abs=1e-6)


@pytest.mark.usefixtures("one_backend")
def test_a_sigma_of_each_pixel_is_learnt(room: Dataset) -> None:
    """Of 2 mm, a Kinect's at the depths of the room being several times as much."""
    noise = PixelNoise(np.full(room.camera.shape, 0.002, np.float32))
    found = learn_sigma(Stating("walk", room.camera, source=room, noise=noise), Config(VOXEL))
    depths = np.concatenate([f.depth_m[f.depth_m > 0] for f in (room.read(i) for i in range(len(room)))])
    true_m = float(np.polynomial.polynomial.polyval(np.median(depths), SensorConfig().sigma))
    found_m, voxel_m = found.law.scale * 0.002 + found.law.added_m, VOXEL_SPREAD * VOXEL
    assert found.after > found.before
    assert true_m / CLOSE < math.hypot(found_m, voxel_m) < CLOSE * math.hypot(true_m, voxel_m)
    assert abs(math.log(found_m / true_m)) < abs(math.log(0.002 / true_m))


@pytest.mark.parametrize(("factor", "gain", "said"), [(3.4, 0.012, 1), (3.4, 0.003, 0), (2.5, 0.012, 0)])
def test_a_large_factor_is_told_although_voxels_hide_it(factor: float, gain: float, said: int) -> None:
    notes = noise_notes(SensorConfig(), NoiseCheck(factor, gain, 8, 40_000), None)
    assert len(notes) == said
    assert all("likeliest with 3.4 times" in note and "by 0.012 nats" in note for note in notes)


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize(
    ("voxel_m", "factor", "words"),
    [
        (0.05, 3.0, "differ from the map by 3"),
        (0.05, 1.5, None),
        (0.2, 3.0, "voxels are so large that they hide the noise"),
        (0.2, 1.5, None),
    ],
)
def test_a_recording_of_three_times_the_stated_noise_is_told_and_one_of_half_as_much_is_not(
    voxel_m: float, factor: float, words: str | None
) -> None:
    """Voxels of 5 cm show that noise, those of 20 cm hide most of it."""
    room = open_dataset("synthetic:room?frames=40&width=160&height=120", color=False)
    stated = SensorConfig(sigma=tuple(c / factor for c in SensorConfig().sigma))
    result = map_sequence(room, Config(voxel_m, sensor=stated))
    frames = [room.read(index) for index in enough_of(result.held_out)]
    check = check_noise(result.map, frames, most=CONTRADICTED)
    assert check is not None
    assert check.wrong == (factor == 3.0 and voxel_m == 0.05)
    notes = noise_notes(stated, check, None)
    assert len(notes) == (words is not None)
    assert all(str(words) in note for note in notes)


@pytest.mark.usefixtures("one_backend")
def test_a_default_noise_of_a_long_recording_is_doubted_and_a_stated_one_that_is_far_off(
    room: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = Config(VOXEL)
    assert sigma_of_glance(room, config) is None, "12 frames are too few"
    monkeypatch.setattr(from_recording, "GLANCE_COST", 1)
    monkeypatch.setattr(from_recording, "GLANCE", 12)
    assert sigma_of_glance(room, config) is None, "its noise is the default"
    noisy = Noisy(room.name, room.camera, source=room)
    learnt = sigma_of_glance(noisy, config)
    assert learnt is not None
    assert learnt.after > learnt.before
    sigma_m = learnt.law.scale * np.polynomial.polynomial.polyval(2.0, SensorConfig().sigma)
    assert 0.1 / CLOSE < sigma_m + learnt.law.added_m < 0.1 * CLOSE
    near = replace(config, sensor=SensorConfig(sigma=(0.05,)))
    assert sigma_of_glance(noisy, near) is None, "the user has said what it is"
    far_off = replace(config, sensor=SensorConfig(sigma=(0.02,)))
    learnt = sigma_of_glance(noisy, far_off)
    assert learnt is not None
    assert 3 * 0.02 < learnt.law.scale * 0.02 + learnt.law.added_m < 0.1 * CLOSE
    assert sigma_of_glance(chosen(noisy, range(5)), far_off) is None, "5 frames are too few"
    dense = replace(config, inference=InferenceConfig(surface_density=20.0))
    assert sigma_of_glance(noisy, dense) is None, "rays are long for such a prior"
    assert sigma_of_glance(noisy, replace(config, method="log_odds")) is None
    noisy.tracked = True
    assert sigma_of_glance(noisy, config) is None
