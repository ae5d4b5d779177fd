"""Maps of one room that were made in worlds of their own become one map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree
from two_days import CONFIG, COUNT, TODAY, YESTERDAY, recorded, turned_away

import taichi_mrf as tm
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.room import SPOTS
from taichi_mrf.datasets.synthetic.room_furniture import ROOM_IN_WORLD
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.mapping.merging import frame_of, lay_over, merge
from taichi_mrf.mapping.onto import freeze_all, locate
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.moved_evidence import MOST
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.queries.changed_things import things_between
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")


def made(indices: range, T_world_room: Pose | None = None, name: str = "frame") -> MRFMap:
    m = map_sequence(recorded(indices, T_world_room, name=name), CONFIG).map
    assert isinstance(m, MRFMap)
    return m


def test_two_maps_become_that_of_one_run() -> None:
    merged = tm.merge([made(YESTERDAY), made(TODAY, turned_away(), "today")], ["a", "b"])
    at_once = made(range(2 * COUNT))
    assert len(merged.map.keyframes) == 2 * COUNT
    poses = {k.name.split("-")[1]: k.T_world_camera for k in merged.map.keyframes.values()}
    stamps = {k.name.split("-")[1]: k.stamp_s for k in merged.map.keyframes.values()}
    for keyframe in at_once.keyframes.values():
        number = keyframe.name.split("-")[1]
        turned_rad, shifted_m = tangent_norms(keyframe.T_world_camera, poses[number])
        assert shifted_m < 0.02
        assert np.degrees(turned_rad) < 0.5
        assert stamps[number] == keyframe.stamp_s
    centres, _ = at_once.voxels()
    agree = (merged.map.occupied_within(centres, CONFIG.voxel_size) > 0.5).mean()
    assert agree > 0.98
    assert merged.loops >= COUNT // 2
    assert merged.moved_m < 0.02


def test_loops_mend_a_map_that_is_bent() -> None:
    """Each pose of today is off by 2 cm. Where both maps see the same, that is mended."""
    bent = recorded(TODAY, turned_away(2), name="today")
    random = np.random.default_rng(1)
    for n, frame in enumerate(bent.frames):
        T = frame.T_world_camera.copy()
        T[:3, 3] += random.normal(0, 0.02, 3)
        bent.frames[n] = replace(frame, T_world_camera=T)
    m = map_sequence(bent, CONFIG).map
    merged = merge([made(YESTERDAY), m])
    T_room_today = merged.located[0].T_map_recording
    assert T_room_today is not None
    rigid, solved = [], []
    true = {f.name: f.T_world_camera for f in recorded(TODAY, name="today").frames}
    after = {k.name: k.T_world_camera for k in merged.map.keyframes.values()}
    for keyframe in m.keyframes.values():
        placed = T_room_today @ keyframe.T_world_camera
        rigid.append(tangent_norms(true[keyframe.name], placed)[1])
        solved.append(tangent_norms(true[keyframe.name], after[keyframe.name])[1])
    assert np.mean(solved) < 0.7 * np.mean(rigid)


def test_a_third_map_is_found_in_the_second() -> None:
    """The first and the third map see other parts of the room."""
    first, third = made(range(0, 6)), made(range(14, 20), turned_away(1), "third")
    assert locate(first, [frame_of(k) for k in third.keyframes.values()]).T_map_recording is None
    second = made(range(0, 20), turned_away(4), "second")
    merged = merge([first, third, second])
    true = {f.name: f.T_world_camera for f in recorded(range(14, 20), name="third").frames}
    for keyframe in merged.map.keyframes.values():
        if keyframe.name in true:
            assert tangent_norms(true[keyframe.name], keyframe.T_world_camera)[1] < 0.04


def test_the_same_names_and_another_noise_are_kept_apart() -> None:
    a, b = made(YESTERDAY), made(YESTERDAY, turned_away())
    wider = MRFMap(CONFIG.voxel_size, PolynomialNoise((0.03,)))
    for keyframe in b.keyframes.values():
        wider.add(frame_of(keyframe))
    wider.infer()
    merged = merge([a, wider])
    names = [keyframe.name for keyframe in merged.map.keyframes.values()]
    assert len(set(names)) == 2 * COUNT
    assert sum(name.startswith("2:") for name in names) == COUNT
    noises = [k.own.noise for k in merged.map.keyframes.values() if k.name.startswith("2:")]
    assert all(isinstance(noise, PolynomialNoise) for noise in noises)
    assert all(k.own.noise is None for k in merged.map.keyframes.values() if not k.name.startswith("2:"))


def test_maps_that_cannot_be_merged_are_named() -> None:
    a = made(YESTERDAY)
    with pytest.raises(ConfigError, match="pass two maps"):
        merge([a])
    with pytest.raises(ConfigError, match=r"^b: maps of the method mrf can be merged, not log_odds"):
        merge([a, LogOddsMap(0.1)], ["a", "b"])
    elsewhere = made(TODAY)
    for id, keyframe in list(elsewhere.keyframes.items()):
        elsewhere.remove_keyframe(id)
        elsewhere.add(replace(frame_of(keyframe), depth_m=np.full_like(keyframe.depth_m, 1.3)))
    with pytest.raises(DatasetError, match=r"^b: not found in any other map: "):
        merge([a, elsewhere], ["a", "b"])
    a.freeze_keyframe(next(iter(a.keyframes)))
    with pytest.raises(ConfigError, match=r"^b: has voxels of 0\.08 m, and the first map of 0\.1 m: "):
        merge([MRFMap(0.1), a], ["a", "b"])
    dated = MRFMap(CONFIG.voxel_size, time=TimeConfig(half_life_s=10.0))
    with pytest.raises(ConfigError, match=r"^b: frozen evidence cannot be moved where time\.half_life_s"):
        merge([dated, a], ["a", "b"])
    with pytest.raises(ConfigError, match=r"^the other map: has voxels of 0\.08 m"):
        MRFMap(0.1).take_in(a, np.eye(4))


def test_a_map_whose_keyframes_are_frozen_takes_in_another() -> None:
    a, b = made(YESTERDAY), made(TODAY, turned_away(), "today")
    freeze_all(a)
    a.infer()
    centres, _ = a.voxels()
    merged = merge([a, b])
    assert merged.map is a
    assert (len(a.keyframes), len(a.frozen)) == (COUNT, COUNT)
    true = {f.name: f.T_world_camera for f in recorded(TODAY, name="today").frames}
    for keyframe in a.keyframes.values():
        turned_rad, shifted_m = tangent_norms(true[keyframe.name], keyframe.T_world_camera)
        assert shifted_m < 0.08
        assert np.degrees(turned_rad) < 2
    assert (a.state(centres) == tm.OCCUPIED).mean() > 0.9


def frozen(indices: range, T_world_room: Pose | None = None, name: str = "frame") -> MRFMap:
    m = made(indices, T_world_room, name)
    freeze_all(m)
    m.infer()
    return m


def test_maps_of_which_only_voxels_are_left_become_one(tmp_path: Path) -> None:
    """Both in chunks, the second in a world of its own: what either has seen is known, and one wall is not
    two."""
    maps, T_today = [], turned_away()
    for name, m in (("0", made(range(0, 20))), ("1", made(range(12, 32), T_today, "today"))):
        tm.export_map(m, tmp_path / f"{name}.zarr")
        maps.append(tm.load_map(tmp_path / f"{name}.zarr"))
    merged = tm.merge(maps)
    turned_rad, shifted_m = tangent_norms(T_today @ known(merged.located[0].T_map_recording), np.eye(4))
    assert np.degrees(turned_rad) < 1
    assert shifted_m < 0.1  # of the origin of the other world, which is metres away
    assert len(merged.map.frozen) == 2
    at_once = frozen(range(2 * COUNT))
    state = merged.map.marginals.state
    walls, _ = at_once.marginals.voxels()
    first = tm.load_map(tmp_path / "0.zarr")
    found, _ = merged.map.marginals.voxels()
    assert share_beside(walls, first.marginals.voxels()[0]) < 0.9
    assert share_beside(walls, found) > 0.95
    assert share_beside(found, walls) > 0.97
    assert len(found) < 1.2 * len(walls)
    grid = np.stack(np.meshgrid(*[np.arange(-3, 3, 0.16)] * 3, indexing="ij"), -1)
    places = grid.reshape(-1, 3) + np.array(ROOM_IN_WORLD)
    before, after = at_once.marginals.state(places), state(places)
    free, unknown = before == tm.FREE, before == tm.UNKNOWN
    assert (after[free] == tm.FREE).mean() > 0.97
    assert (after[unknown] == tm.UNKNOWN).mean() > 0.96
    # Resampling carries evidence by a voxel, so beside known places the rounding of the pose decides.
    apart = ~maximum_filter(~unknown.reshape(grid.shape[:3]), 3).ravel()
    assert (after[apart] == tm.UNKNOWN).mean() > 0.99


def share_beside(centres: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Share of voxels (n, 3) that have one of others (m, 3) within the size of a voxel."""
    away_m, _ = cKDTree(others).query(centres)
    return float((away_m < 1.01 * CONFIG.voxel_size).mean())


def known(T: Pose | None) -> Pose:
    assert T is not None
    return T


def test_a_quarter_turn_moves_frozen_evidence_exactly() -> None:
    """Voxels come to lie on voxels: all log-odds up to the bound are those of the map that was turned."""
    m, quarter = frozen(YESTERDAY), np.eye(4)
    quarter[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    quarter[:3, 3] = np.array([5, -9, 2]) * CONFIG.voxel_size
    turned = MRFMap.with_noise(CONFIG, m.noise)
    turned.take_in(m, quarter)
    turned.infer()
    centres, p = m.marginals.voxels(min_probability=0.0)
    moved = centres @ quarter[:3, :3].T + quarter[:3, 3]
    # Of a brick that is only free, no more is kept than that.
    prior = m.view.pool.prior_log_odds
    bounds = [1 / (1 + np.exp(-prior - told)) for told in (-m.LIMITS.message, MOST)]
    there = np.clip(turned.marginals.occupancy(moved), *bounds)
    np.testing.assert_allclose(there, np.clip(p, *bounds), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(turned.marginals.state(moved), m.marginals.state(centres))
    assert len(turned.marginals.voxels()[0]) == len(m.marginals.voxels()[0])
    again = turned.marginals.occupancy(moved)
    for keyframe in made(TODAY).keyframes.values():
        turned.add(replace(frame_of(keyframe), T_world_camera=quarter @ keyframe.T_world_camera))
    turned.infer()
    assert (turned.marginals.occupancy(moved) != again).any()
    assert len(turned.keyframes) == COUNT


def test_a_map_that_is_turned_and_shifted_keeps_its_walls(tmp_path: Path) -> None:
    """By 37 degrees, half a voxel and more, and saved: no wall is lost, none is doubled."""
    m, T = frozen(YESTERDAY), np.eye(4)
    c, s = np.cos(np.radians(37)), np.sin(np.radians(37))
    T[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    T[:3, 3] = 0.3, -0.11, 0.04
    turned = MRFMap.with_noise(CONFIG, m.noise)
    turned.take_in(m, T)
    turned.infer()
    turned.save(tmp_path / "turned.npz")
    turned = MRFMap.load(tmp_path / "turned.npz")
    assert list(turned.frozen.values()) == list(m.frozen.values())
    walls, _ = m.marginals.voxels()
    moved = walls @ T[:3, :3].T + T[:3, 3]
    found, _ = turned.marginals.voxels()
    assert share_beside(moved, found) > 0.95
    assert share_beside(found, moved) > 0.99
    assert 0.85 < len(found) / len(walls) < 1.1


def test_frozen_evidence_moves_and_keyframes_join() -> None:
    """A later map half of which is frozen."""
    a, b = made(YESTERDAY), made(TODAY, turned_away(), "today")
    for id in list(b.keyframes)[::2]:
        b.freeze_keyframe(id)
    merged = merge([a, b])
    assert (len(merged.map.keyframes), len(merged.map.frozen)) == (COUNT + COUNT // 2, COUNT // 2)
    assert merged.loops > 0
    centres, _ = made(range(2 * COUNT)).marginals.voxels()
    near = merged.map.marginals.occupied_within(centres, CONFIG.voxel_size)
    assert (near > 0.5).mean() > 0.97


def of_the_moving_room(seconds: range, T_world_room: Pose) -> MRFMap:
    """A map of some seconds of the room in which things come and go, by voxels of 5 cm."""
    dataset = open_dataset("synthetic:room?moving=things&frames=60&width=320&height=240")
    m = MRFMap.from_config(replace(CONFIG, voxel_size=0.05), dataset.camera)
    for second in seconds:
        frame = dataset.read(second)
        m.add(replace(frame, T_world_camera=T_world_room @ frame.T_world_camera))
    m.infer()
    return m


def test_what_was_moved_between_the_days_is_all_that_differs() -> None:
    """A crate left, a chair was moved, a stool came (synthetic/room.py), in a map of another world."""
    a, b = of_the_moving_room(range(20), np.eye(4)), of_the_moving_room(range(43, 60), turned_away(6))
    found = lay_over(a, b)
    assert found is not None
    assert found.T_map_recording is not None, found.reason
    things = things_between(compare_maps(a, b), a, b)
    origin_m = np.array(ROOM_IN_WORLD)
    told = {(thing.verb, *np.round(thing.centre_m - origin_m, 1)[:2].tolist()) for thing in things}
    spots = {verb: [SPOTS[n] for n in places] for verb, places in (("left", (1, 2)), ("appeared", (3, 4)))}
    assert len(things) == 4
    for verb, places in spots.items():
        for place in places:
            near = [t for t in told if t[0] == verb and np.hypot(t[1] - place[0], t[2] - place[1]) < 0.2]
            assert len(near) == 1, (verb, place, told)


def test_maps_of_one_world_are_compared_as_they_stand() -> None:
    a, b = made(YESTERDAY), made(TODAY)
    before = [keyframe.T_world_camera for keyframe in b.keyframes.values()]
    assert lay_over(a, b) is None
    for keyframe, T in zip(b.keyframes.values(), before, strict=True):
        np.testing.assert_array_equal(keyframe.T_world_camera, T)
    assert lay_over(LogOddsMap(0.1), b) is None
    assert lay_over(a, MRFMap(0.1)) is None


def test_one_place_seen_twice_has_no_things_that_came_or_left() -> None:
    a, b = (of_the_moving_room(seconds, np.eye(4)) for seconds in (range(0, 20, 2), range(1, 20, 2)))
    assert not things_between(compare_maps(a, b), a, b)
