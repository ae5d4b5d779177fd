"""A well-formed map file with a wrong number in it: each array in turn is refused by its name, or read and
asked about without harm."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.config.schema import Config
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.errors import CapacityError, MapFileError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import MANIFEST

CAMERA = PinholeCamera(8, 6, 6.0, 6.0, 3.5, 2.5)

pytestmark = pytest.mark.usefixtures("one_backend")


@pytest.fixture(scope="module")
def arrays(one_backend: object, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The arrays of a map that has dates, colours, frozen keyframes and what these have measured."""
    m = MRFMap.from_config(
        Config(0.25, color=True, keep_surface=True, time=TimeConfig(half_life_s=5.0)), CAMERA
    )
    for i in range(3):
        depth_m, color = np.full(CAMERA.shape, 1.5 + 0.1 * i, np.float32), np.full((6, 8, 3), 90, np.uint8)
        m.add_keyframe(depth_m, np.eye(4), CAMERA, f"frame {i}", stamp_s=float(i), color=color)
    m.infer()
    m.freeze_keyframe(0)
    m.infer()
    path = tmp_path_factory.mktemp("arrays") / "map.npz"
    m.save(path)
    with np.load(path) as file:
        whole = {name: file[name] for name in file.files if name != MANIFEST}
    # Without the defaults, which take most of the time that it takes to read such a small map.
    short = "voxel_size: 0.25\ncolor: true\nkeep_surface: true\ntime: {half_life_s: 5.0}"
    return whole | {"config": np.asarray(short)}


def damaged(array: np.ndarray) -> Iterator[np.ndarray]:
    """The array with numbers that its type allows, shortened, and with all rows twice."""
    if array.dtype.kind in "iu":
        numbers = [np.iinfo(array.dtype).min, np.iinfo(array.dtype).max, 4096, 512, -1]
    else:
        numbers = [-1e30, 1e30] if array.dtype.kind == "f" else []
    for number in numbers if array.size else ():
        if array.dtype.kind != "u" or number >= 0:
            first = array.copy()
            first.flat[0] = np.array(number).astype(array.dtype)
            yield first
            if number in numbers[:2]:
                yield np.full_like(array, first.flat[0])
    if array.ndim and len(array):
        yield from (array[:-1], np.concatenate([array, array]))


def test_each_array_is_refused_or_read_without_harm(arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    path, refused = tmp_path / "map.npz", set()
    for name, array in arrays.items():
        for wrong in damaged(array):
            write_npz(path, {**arrays, name: wrong}, manifest=True)
            try:
                m = MRFMap.load(path)
            except (MapFileError, CapacityError) as error:
                refused.add(name if str(path) in str(error) else f"{name}, without the file's name")
                continue
            centres, marginals = m.voxels(0.0)
            assert np.isfinite(marginals).all()
            assert len(m.colors(centres)) == len(m.state(centres)) == len(centres)
            if array.dtype.kind in "iu":
                m.infer()
    places = {name for name in arrays if name.endswith(("bricks", "crossed", "numbers", "owners", "ids"))}
    assert len(places) >= 8
    assert places <= refused <= arrays.keys()


@pytest.mark.parametrize(
    ("name", "number", "words"),
    [
        (
            "keyframe_T_world_camera",
            -1.0,
            "keyframe_T_world_camera of frame 1 is damaged: the last row of a pose",
        ),
        ("keyframe_cameras", 0.0, "keyframe_cameras is damaged: camera width must be at least 1, not 0"),
        ("keyframe_ids", 7, "damaged: keyframe_ids are not valid below next_id, or not distinct"),
    ],
)
def test_values_that_cannot_be_are_refused_by_the_arrays_name(
    name: str, number: float, words: str, arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    wrong = np.full_like(arrays[name], number)
    write_npz(tmp_path / "map.npz", {**arrays, name: wrong}, manifest=True)
    with pytest.raises(MapFileError, match=rf"map\.npz: {words}"):
        MRFMap.load(tmp_path / "map.npz")


@pytest.mark.parametrize("name", ["frozen_crossed", "bricks", "frozen_owners", "frozen_ids"])
def test_the_error_names_the_array_and_the_number(
    name: str, arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    wrong = arrays[name].copy()
    wrong.flat[0] = 100_000
    write_npz(tmp_path / "map.npz", {**arrays, name: wrong}, manifest=True)
    with pytest.raises(MapFileError, match=rf"map\.npz: {name} holds 100000, which is not from -?\d+ to \d+"):
        MRFMap.load(tmp_path / "map.npz")
