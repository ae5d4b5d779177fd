"""A map carries its whole configuration, and so does its file: every field comes back, for every method."""

import dataclasses
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_room

from taichi_mrf.cli.main import main
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.text import differences
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.session.source import open_source
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import MANIFEST

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)
OTHER = {
    "sensor.sigma_table": None,  # what a table's file says is in the noise; its path may be gone
    "sensor.bias_table": None,
    "sensor.bias": (0.01, 0.002),
    "inference.prior": 0.2,
    "volume.lower": (-1.0, -2.0, -3.0),
    "volume.upper": (4.0, 5.0, 6.0),
    "volume.origin": (1000.0, 2000.0, 0.0),
    "visibility.visible_if_clear": 0.9,
}
"""Values for the fields to which ``another`` has no answer."""


def another(value: Any, hint: Any) -> Any:
    """A possible value of a field that is not its default."""
    if typing.get_origin(hint) is typing.Literal:
        return next(each for each in typing.get_args(hint) if each != value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return tuple(0.9 * each for each in value)
    if isinstance(value, int):
        return value + 2
    return value * 0.97 if value else 0.25


def changed(section: Any, method: str, prefix: str = "") -> Any:
    """A section none of whose fields has its default, but for what the method cannot do."""
    hints = typing.get_type_hints(type(section))
    values = {}
    for field in dataclasses.fields(section):
        name, value = prefix + field.name, getattr(section, field.name)
        if name == "method":
            values[field.name] = method
        elif name == "volume.window_m" and not METHODS[method].can_freeze:
            values[field.name] = 0.0
        elif name in ("color", "keep_surface") and not METHODS[method].has_colors:
            values[field.name] = False
        elif name in OTHER:
            values[field.name] = OTHER[name]
        elif dataclasses.is_dataclass(value):
            values[field.name] = changed(value, method, f"{name}.")
        else:
            values[field.name] = another(value, hints[field.name])
    return dataclasses.replace(section, **values)


@pytest.mark.parametrize("method", METHODS)
def test_every_field_of_the_configuration_is_saved(method: str, tmp_path: Path) -> None:
    config = changed(Config(), method)
    unchanged = {"sensor.sigma_table", "sensor.bias_table"}
    unchanged |= {"method"} if METHODS[method].can_freeze else {"volume.window_m", "color", "keep_surface"}
    all_names = differences(Config(), config)
    assert len(all_names) + len(unchanged) == sum(1 for _ in leaves(Config()))
    m = create_map(config, CAMERA)
    assert m.config == config
    m.add_keyframe(np.full(CAMERA.shape, 1.5, np.float32), np.eye(4), CAMERA)
    m.save(tmp_path / "map.npz")
    assert differences(load_map(tmp_path / "map.npz").config, config) == []


def leaves(section: Any) -> typing.Iterator[str]:
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        yield from leaves(value) if dataclasses.is_dataclass(value) else [field.name]


@pytest.mark.parametrize("method", METHODS)
def test_a_noise_model_given_as_an_object_is_in_the_configuration(method: str) -> None:
    m = METHODS[method].load_class()(0.1, PolynomialNoise((0.05, 0.0, 0.001), (0.02,)))
    assert m.config.sensor == SensorConfig(sigma=(0.05, 0.0, 0.001), bias=(0.02,))
    assert m.sensor is m.config.sensor


def test_a_map_of_an_earlier_version_gets_its_sensor_from_its_noise(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    small_room.build([0]).save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in (MANIFEST, "settled")}
    arrays["noise_sigma"] = np.array([[0.05, 0.0, 0.0, 0.0, 0.0]])
    write_npz(path, arrays, manifest=True)
    loaded = load_map(path)
    assert loaded.config.sensor.sigma == (0.05,)
    assert loaded.settled


def test_flags_of_a_run_are_in_its_map_and_on_the_page_opened_from_it(tmp_path: Path) -> None:
    flags = [
        "--sensor.sigma",
        "0.05",
        "--sensor.bias",
        "0.01",
        "--poses.doubt-rotation",
        "0.001",
        "--keyframes.rotation",
        "0.1",
    ]
    source = "synthetic:room?width=80&height=60&frames=4"
    code = main(
        ["map", source, "--out", str(tmp_path / "run"), "--no-pictures", "--voxel-size", "0.2", *flags]
    )
    assert code == 0
    config = load_map(tmp_path / "run" / "map.npz").config
    assert config.sensor == SensorConfig(sigma=(0.05,), bias=(0.01,))
    assert (config.poses.doubt_rotation, config.keyframes.rotation, config.voxel_size) == (0.001, 0.1, 0.2)
    opened, notes = open_source(
        str(tmp_path / "run" / "map.npz"), Config(), every=1, limit=None, speed=1.0, loop=False
    )
    assert dataclasses.replace(opened.config, runtime=config.runtime) == config
    assert len(notes) == 1


def test_a_file_says_whether_inference_was_complete(tmp_path: Path) -> None:
    m = small_room.build([0, 1])
    assert m.settled

    def stop(step: InferProgress) -> bool:
        return step.keyframe < 2

    for spoil in (
        lambda: m.infer(progress=stop),
        lambda: m.infer(sweeps=1),
        lambda: m.infer(keyframes=[0]),
        lambda: m.renew([0]),
        lambda: m.move_keyframe(0, m.keyframes[0].T_world_camera),
        lambda: small_room.add(m, small_room.frames()[2]),
        lambda: m.remove_keyframe(2),
    ):
        spoil()
        assert not m.settled
        m.save(tmp_path / "stopped.npz")
        assert not load_map(tmp_path / "stopped.npz").settled
        _, notes = open_source(
            str(tmp_path / "stopped.npz"), Config(), every=1, limit=None, speed=1.0, loop=False
        )
        assert "saved before its inference was complete" in notes[1]
        m.infer()
        assert m.settled
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert loaded.settled
    loaded.infer()
    np.testing.assert_array_equal(loaded.occupancy(small_room.probes()), m.occupancy(small_room.probes()))


def test_a_stopped_inference_that_is_undone_is_settled_again() -> None:
    m = small_room.build([0, 1])
    checkpoint = m.checkpoint()
    m.infer(progress=lambda step: False)
    assert not m.settled
    m.restore(checkpoint)
    assert m.settled
