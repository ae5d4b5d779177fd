"""A camera and noise models from outside, each written in one class: mapped, saved, loaded, drawn, and named
by a parameter file."""

import importlib
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from plugged_noise import PixelNoise

import taichi_mrf.sensor
from taichi_mrf.config.schema import SensorConfig, load
from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.noise import (
    Curves,
    NoiseTable,
    PatchNoise,
    PolynomialNoise,
    StoredNoise,
    noise_from_config,
)
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.stored import KINDS, Arrays, is_stored, read_stored, stored_arrays
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import open_npz
from taichi_mrf.viewer.tune.plots import NoiseCurves

ONE_BACKEND = pytest.mark.usefixtures("one_backend")
PINHOLE = PinholeCamera(16, 12, 14.0, 14.0, 7.5, 5.5)
DEPTH_M = np.linspace(0.5, 4.0, 9)


class StereoNoise(StoredNoise):
    """sigma of a stereo camera: an error of disparity, in pixels, over focal length (pixels) and baseline."""

    def __init__(self, baseline_m: float, focal_px: float, disparity_px: float) -> None:
        self.values = baseline_m, focal_px, disparity_px

    def table(self, camera: Camera) -> NoiseTable:
        baseline_m, focal_px, disparity_px = self.values
        return PolynomialNoise((0, 0, disparity_px / (baseline_m * focal_px))).table(camera)

    def curves(self, depth_m: NDArray[np.float64]) -> Curves:
        baseline_m, focal_px, disparity_px = self.values
        sigma = disparity_px * depth_m[None] ** 2 / (baseline_m * focal_px)
        return sigma, np.zeros_like(sigma)

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"stereo": np.array(self.values)}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "StereoNoise":
        return cls(*file.array("stereo", "f", (3,)).tolist())


class FisheyeCamera(RayTable):
    """An equidistant fisheye: the angle from the axis grows with the distance from the image's middle."""

    def __init__(self, width: int, height: int, pixels_per_radian: float) -> None:
        self.values = width, height, pixels_per_radian
        x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
        radius = np.hypot(x, y)
        angle = radius / pixels_per_radian
        side = np.sin(angle) / np.maximum(radius, 1e-9)
        super().__init__(np.stack([x * side, y * side, np.cos(angle)], axis=-1))

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"fisheye": np.array(self.values, np.float64)}

    @classmethod
    def of_arrays(cls, file: Arrays) -> "FisheyeCamera":
        width, height, density = file.array("fisheye", "f", (3,)).tolist()
        return cls(int(width), int(height), density)


STEREO, FISHEYE = StereoNoise(0.1, 400.0, 0.25), FisheyeCamera(16, 12, 9.0)
OF_PIXELS = PixelNoise(np.linspace(0.01, 0.03, 16 * 12, dtype=np.float32).reshape(12, 16))


def mapped(m: Any, camera: Camera) -> Any:
    for x in (0.0, 0.2):
        T = np.eye(4)
        T[0, 3] = x
        m.add_keyframe(np.full(camera.shape, 1.5, np.float32), T, camera)
    m.infer()
    return m


def probes() -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))


@ONE_BACKEND
@pytest.mark.parametrize("noise", [STEREO, OF_PIXELS], ids=["polynomial", "own kernels"])
@pytest.mark.parametrize("make", [MRFMap, LogOddsMap])
def test_a_map_keeps_the_classes_after_loading(tmp_path: Path, make: Any, noise: StoredNoise) -> None:
    with_noise = {"noise": noise} if make is MRFMap else {}
    m = mapped(make(0.1, **with_noise), FISHEYE)
    assert np.std(m.occupancy(probes())) > 0.05
    m.add_keyframe(np.full(PINHOLE.shape, 1.4, np.float32), np.eye(4), PINHOLE, noise=STEREO)
    m.infer()
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    np.testing.assert_array_equal(loaded.occupancy(probes()), m.occupancy(probes()))
    first, *_, last = loaded.keyframes.values()
    assert isinstance(first.camera, FisheyeCamera)
    assert first.camera == FISHEYE
    assert isinstance(last.own.noise, StereoNoise)
    assert last.own.noise.values == STEREO.values
    if with_noise:
        assert type(loaded.noise) is type(noise)
        for each in (m, loaded):
            each.remove_keyframe(first.id)
            each.infer()
        np.testing.assert_array_equal(loaded.occupancy(probes()), m.occupancy(probes()))


@ONE_BACKEND
def test_it_maps_as_the_polynomial_of_the_same_values() -> None:
    of_class, of_values = (MRFMap(0.1, noise) for noise in (STEREO, PolynomialNoise((0, 0, 0.00625))))
    found = [mapped(m, PINHOLE).occupancy(probes()) for m in (of_class, of_values)]
    np.testing.assert_array_equal(*found)


@ONE_BACKEND
def test_a_class_that_nobody_imported_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapped(MRFMap(0.1, STEREO), FISHEYE).save(tmp_path / "map.npz")
    monkeypatch.delitem(KINDS, "FisheyeCamera")
    with pytest.raises(
        MapFileError,
        match=r"map\.npz: camera_0 is of the class FisheyeCamera, which is not",
    ):
        load_map(tmp_path / "map.npz")


@pytest.mark.parametrize("thing", [STEREO, FISHEYE, PINHOLE, PolynomialNoise((0.01,))])
def test_what_a_file_holds_is_found_by_any_of_its_names(tmp_path: Path, thing: Any) -> None:
    """Also if an array tells its class, and no name does."""
    write_npz(tmp_path / "own.npz", {**stored_arrays(thing, "own_"), "other": np.zeros(1)})
    with open_npz(tmp_path / "own.npz", MapFileError, "a file") as file:
        assert is_stored(file, "own_")
        assert not is_stored(file, "another_")


def test_a_class_of_the_package_is_found_by_a_program_that_has_not_imported_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the console program has not, where no user can import anything."""
    (tmp_path / "added_noise.py").write_text(
        "from taichi_mrf.sensor.noise import PolynomialNoise\n\n\nclass AddedNoise(PolynomialNoise):\n"
        "    arrays = lambda self: {'added': self.sigma}\n"
        "    of_arrays = classmethod(lambda cls, file: cls(file.array('added', 'f', (1, None))[0]))\n"
    )
    monkeypatch.setattr(taichi_mrf.sensor, "__path__", [*taichi_mrf.sensor.__path__, str(tmp_path)])
    added = importlib.import_module("taichi_mrf.sensor.added_noise")
    write_npz(tmp_path / "noise.npz", stored_arrays(added.AddedNoise((0.02,))))
    monkeypatch.delitem(sys.modules, added.__name__)
    monkeypatch.delitem(KINDS, "AddedNoise")
    with open_npz(tmp_path / "noise.npz", MapFileError, "a file") as file:
        found = read_stored(file)
    assert type(found).__name__ == "AddedNoise"
    np.testing.assert_array_equal(np.ravel(found.sigma), np.ravel(added.AddedNoise((0.02,)).sigma))


def test_a_camera_of_rays_is_pickled_as_its_own_class() -> None:
    FISHEYE.rays()
    again = pickle.loads(pickle.dumps(FISHEYE))
    assert (type(again), again.values, again) == (FisheyeCamera, FISHEYE.values, FISHEYE)


def named_by(tmp_path: Path, noise: StoredNoise, more: str = "") -> SensorConfig:
    """The sensor of a parameter file that names the file of a noise model beside it."""
    write_npz(tmp_path / "noise.npz", stored_arrays(noise))
    (tmp_path / "sensor.yaml").write_text(f"sensor: {{sigma_table: noise.npz{more}}}\n")
    return load(tmp_path / "sensor.yaml").sensor


def test_a_parameter_file_names_it_and_its_curves_are_drawn(tmp_path: Path) -> None:
    sensor = named_by(tmp_path, STEREO)
    found = noise_from_config(sensor, PINHOLE)
    assert isinstance(found, StereoNoise)
    assert found.values == STEREO.values
    curves = NoiseCurves.of(sensor)
    bias, sigma = curves.at(DEPTH_M)
    np.testing.assert_allclose(sigma, 0.00625 * DEPTH_M**2)
    assert not bias.any()
    assert "noise model" in curves.note


def test_learnt_tables_are_named_by_one_file_and_scaled(tmp_path: Path) -> None:
    learnt = PatchNoise([[0.01, 0.0, 0.002]] * 12, [[0.003]] * 12, 4, PINHOLE)
    sensor = named_by(tmp_path, learnt, ", sigma_scale: 2.0")
    found = noise_from_config(sensor, PINHOLE)
    assert isinstance(found, PatchNoise)
    np.testing.assert_array_equal(found.sigma, 2 * learnt.sigma)
    np.testing.assert_allclose(NoiseCurves.of(sensor).at(DEPTH_M)[1], 0.02 + 0.004 * DEPTH_M**2)


def test_files_that_hold_no_noise_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"sensor\.bias_table: leave it out"):
        noise_from_config(named_by(tmp_path, STEREO, ", bias_table: bias.npy"), PINHOLE)
    write_npz(tmp_path / "noise.npz", stored_arrays(PINHOLE))
    with pytest.raises(ConfigError, match=r"noise\.npz: holds a PinholeCamera, not a noise model"):
        noise_from_config(SensorConfig(sigma_table=str(tmp_path / "noise.npz")), PINHOLE)
    write_npz(tmp_path / "noise.npz", stored_arrays(PolynomialNoise((0.1,))))
    with pytest.raises(ConfigError, match=r"noise\.npz: holds a PolynomialNoise, not a PatchNoise"):
        PatchNoise.load(tmp_path / "noise.npz")
    with pytest.raises(MapFileError, match="a noise model of type object cannot be saved"):
        stored_arrays(object())
