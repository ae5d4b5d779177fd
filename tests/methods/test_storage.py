"""Maps on disk: what is loaded is what was saved, can be extended, and a bad file says so."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_room

from taichi_mrf.errors import MapFileError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PatchNoise

pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_loaded_map_goes_on_as_if_it_had_never_been_saved(tmp_path: Path) -> None:
    m = small_room.build([0, 1])
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    assert loaded.config == m.config
    assert [k.name for k in loaded.keyframes.values()] == [k.name for k in m.keyframes.values()]
    small_room.add(loaded, small_room.frames()[2])
    (first, *_) = loaded.keyframes
    loaded.remove_keyframe(first)
    loaded.infer()
    probes = small_room.probes()
    np.testing.assert_array_equal(loaded.occupancy(probes), small_room.build([1, 2]).occupancy(probes))


def test_a_loaded_map_knows_at_once_who_sees_a_voxel(tmp_path: Path) -> None:
    m = small_room.build([0, 1, 2])
    seen = m.seen_by(m.view.pool.in_order)
    assert seen.max() == 3
    m.save(tmp_path / "map.npz")
    loaded = MRFMap.load(tmp_path / "map.npz")
    np.testing.assert_array_equal(loaded.seen_by(loaded.view.pool.in_order), seen)
    np.testing.assert_array_equal(loaded.occupancy(small_room.probes()), m.occupancy(small_room.probes()))


def test_patch_noise_is_stored(tmp_path: Path) -> None:
    camera = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)
    tables = np.random.default_rng(0).uniform(0.01, 0.02, (2, 12, 2))
    m = MRFMap(0.1, PatchNoise(tables[0], tables[1], 10, camera))
    m.add_keyframe(np.full(camera.shape, 1.5, np.float32), np.eye(4), camera)
    m.save(tmp_path / "map.npz")
    noise = MRFMap.load(tmp_path / "map.npz").noise
    assert isinstance(noise, PatchNoise)
    np.testing.assert_array_equal(noise.table(camera).coefficients, m.noise.table(camera).coefficients)


def test_an_empty_map_is_a_map(tmp_path: Path) -> None:
    MRFMap(0.1).save(tmp_path / "map.npz")
    assert MRFMap.load(tmp_path / "map.npz").statistics().voxels == 0


def test_saving_over_a_map_replaces_it_whole(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    small_room.build([0]).save(path)
    small_room.build([1]).save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]
    assert [k.name for k in MRFMap.load(path).keyframes.values()] == [small_room.frames()[1].name]


def without_belief(whole: Path, path: Path) -> None:
    with np.load(whole) as file:
        np.savez(path, **{name: file[name] for name in file.files if name != "belief"})


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda whole, path: None, "no such file"),
        (lambda whole, path: path.write_bytes(b""), "not a readable map"),
        (lambda whole, path: path.write_bytes(b"not a zip at all"), "not a readable map"),
        (lambda whole, path: path.write_bytes(whole.read_bytes()[:5000]), "not a readable map"),
        (lambda whole, path: np.savez(path, a=np.zeros(3)), "not a map"),
        (without_belief, "belief"),
    ],
    ids=["none", "empty", "text", "cut", "other arrays", "a part"],
)
def test_a_bad_file_is_named(tmp_path: Path, write: Callable[[Path, Path], object], message: str) -> None:
    whole, path = tmp_path / "whole.npz", tmp_path / "map.npz"
    small_room.build([0]).save(whole)
    write(whole, path)
    with pytest.raises(MapFileError, match=message) as caught:
        MRFMap.load(path)
    assert str(path) in str(caught.value)
