"""Properties of all maps that integrate scan by scan: any history ends in the map of the final scans,
what was never seen stays apart from what was, and maps come back from disk as they went."""

from pathlib import Path

import numpy as np
import pytest
import small_room
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.config.schema import Config
from taichi_mrf.config.sections import VisibilityConfig
from taichi_mrf.errors import KeyframeError, MapFileError
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.recursive import RecursiveMap
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.methods.visibility.map import VisibilityMap
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.atomic import write_npz
from taichi_mrf.system.npz_file import MANIFEST

pytestmark = pytest.mark.usefixtures("one_backend")

METHODS: dict[str, type[RecursiveMap]] = {"log_odds": LogOddsMap, "visibility": VisibilityMap}
CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)


@pytest.fixture(params=METHODS)
def method(request: pytest.FixtureRequest) -> str:
    return request.param


def empty(method: str) -> RecursiveMap:
    m = create_map(Config(small_room.VOXEL_SIZE, method), small_room.frames()[0].camera)
    assert isinstance(m, METHODS[method])
    return m


def add(m: RecursiveMap, number: int) -> int:
    return small_room.add(m, small_room.frames()[number])


def build(method: str, numbers: list[int]) -> RecursiveMap:
    m = empty(method)
    for number in numbers:
        add(m, number)
    return m


def assert_same_map(a: RecursiveMap, b: RecursiveMap) -> None:
    probes = small_room.probes()
    np.testing.assert_array_equal(a.occupancy(probes), b.occupancy(probes))
    np.testing.assert_array_equal(a.state(probes), b.state(probes))
    assert a.statistics().bricks == b.statistics().bricks


def test_a_scan_is_integrated_when_it_is_added(method: str) -> None:
    m = build(method, [0])
    centre = small_room.frames()[0].T_world_camera[:3, 3]
    assert m.state([centre])[0] == FREE
    before = m.occupancy(small_room.probes())
    report = m.infer(sweeps=3, tolerance=0.1, keyframes=list(m.keyframes))
    assert (report.rays, report.sweeps, report.complete) == (0, 0, True)
    np.testing.assert_array_equal(m.occupancy(small_room.probes()), before)


def wall(method: str) -> RecursiveMap:
    """A wall at 2.05 m, seen often and by a sensor good enough for VisibilityMap to get there too."""
    m = create_map(Config(0.1, method, visibility=VisibilityConfig(hit_if_free=0.2)), CAMERA)
    assert isinstance(m, RecursiveMap)
    for _ in range(40):
        m.add_keyframe(np.full(CAMERA.shape, 2.05, np.float32), np.eye(4), CAMERA)
    return m


def around_the_wall() -> np.ndarray:
    """Centres of all voxels in a box that holds all that the wall's camera sees."""
    axes = [np.arange(-15, 15), np.arange(-15, 15), np.arange(-5, 30)]
    return (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * 0.1


def test_unknown_free_and_occupied(method: str) -> None:
    m, probes = wall(method), around_the_wall()
    p, state = m.occupancy(probes), m.state(probes)
    np.testing.assert_array_equal(state == UNKNOWN, p == 0.5)
    np.testing.assert_array_equal(state == OCCUPIED, p > 0.5)
    np.testing.assert_array_equal(state == FREE, p < 0.5)
    assert min((state == which).sum() for which in (UNKNOWN, FREE, OCCUPIED)) > 100


def test_voxels_are_those_that_are_known(method: str) -> None:
    m, probes = wall(method), around_the_wall()
    centres, p = m.voxels(0.0)
    assert 0 < len(centres) < m.statistics().voxels
    np.testing.assert_array_equal(m.occupancy(centres), p)
    assert (m.state(centres) != UNKNOWN).all()
    assert (m.state(probes) != UNKNOWN).sum() == len(centres)
    likely, _ = m.voxels()
    assert (m.state(likely) == OCCUPIED).all()
    assert len(likely) == (m.state(centres) == OCCUPIED).sum() > 0


steps = st.lists(
    st.tuples(st.sampled_from(["add", "remove", "move", "infer"]), st.integers(0, 9)), min_size=1, max_size=10
)


@pytest.mark.parametrize("each", METHODS)
@settings(max_examples=10)
@given(history=steps)
def test_any_history_ends_in_the_map_of_the_final_scans(each: str, history: list[tuple[str, int]]) -> None:
    """In the order in which they were first added, bit for bit."""
    room = small_room.frames()
    m = empty(each)
    present: dict[int, tuple[int, int]] = {}  # id: whose image, and whose pose
    for verb, number in history:
        ids = list(present)
        if verb == "add" and len(ids) < 4:
            present[add(m, number)] = (number, number)
        elif verb == "remove" and ids:
            id = ids[number % len(ids)]
            m.remove_keyframe(id)
            del present[id]
        elif verb == "move" and ids:
            id = ids[number % len(ids)]
            m.move_keyframe(id, room[number].T_world_camera)
            present[id] = (present[id][0], number)
        elif verb == "infer":
            m.infer()
    m.infer()
    assert not m.stale
    anew = empty(each)
    for image, pose in present.values():
        small_room.add(anew, room[image], room[pose].T_world_camera)
    assert_same_map(m, anew)


def test_until_inferred_a_changed_map_answers_with_what_it_knew(method: str) -> None:
    m = build(method, [0, 1])
    first, second = m.keyframes
    before = m.occupancy(small_room.probes())
    m.remove_keyframe(second)
    third = add(m, 2)
    assert m.stale
    np.testing.assert_array_equal(m.occupancy(small_room.probes()), before)
    assert list(m.keyframes) == [first, third]
    report = m.infer()
    assert report.rays == sum(k.rays for k in m.keyframes.values()) > 0
    assert_same_map(m, build(method, [0, 2]))


def test_inference_can_be_watched_stopped_and_finished(method: str) -> None:
    m = build(method, [0, 1, 2])
    (first, *_) = m.keyframes
    m.move_keyframe(first, small_room.frames()[0].T_world_camera)
    seen: list[InferProgress] = []

    def stop_at_two(at: InferProgress) -> bool:
        seen.append(at)
        return at.keyframe < 2

    report = m.infer(progress=stop_at_two)
    assert not report.complete
    assert [(at.sweep, at.sweeps, at.keyframe, at.keyframes) for at in seen] == [(1, 1, 1, 3), (1, 1, 2, 3)]
    assert m.stale
    np.testing.assert_array_equal(
        m.occupancy(small_room.probes()), build(method, [0, 1]).occupancy(small_room.probes())
    )
    assert m.infer().complete
    assert_same_map(m, build(method, [0, 1, 2]))


def test_removing_everything_leaves_nothing(method: str) -> None:
    m = build(method, [0, 1])
    for id in list(m.keyframes):
        m.remove_keyframe(id)
    m.infer()
    assert m.statistics().bricks == m.statistics().keyframes == 0
    assert (m.state(small_room.probes()) == UNKNOWN).all()
    camera, T = small_room.frames()[0].camera, small_room.frames()[0].T_world_camera
    assert np.isnan(m.render_depth(camera, T)).all()


def test_rays_pass_the_unknown(method: str) -> None:
    """A wall is seen from a place that no scan has looked at, through bricks that exist."""
    m = wall(method)
    aside = np.eye(4)
    aside[0, 3] = 1.5  # its left half looks at the wall through what is unknown at first
    depth = m.render_depth(CAMERA, aside)
    assert m.state([[1.5, 0.05, 0.15]])[0] == UNKNOWN
    seen = np.isfinite(depth)
    assert seen.mean() > 0.2
    np.testing.assert_allclose(depth[seen], 2.05, atol=0.15)
    profile = m.ray_profile([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    assert abs(profile.distance[np.argmax(profile.omega)] - 2.05) < 0.1


def test_moving_everything_by_whole_bricks_moves_the_map(method: str) -> None:
    """Also far away and to negative coordinates, on whose float32 the map must not depend."""
    shift = np.array([-160.0, 80.0, -8.0]) * 8 * small_room.VOXEL_SIZE
    m, moved = empty(method), empty(method)
    for frame in small_room.frames()[:2]:
        T = frame.T_world_camera.copy()
        m.add_keyframe(frame.depth_m, T, frame.camera)
        T[:3, 3] += shift
        moved.add_keyframe(frame.depth_m, T, frame.camera)
    probes = small_room.probes()
    differ = m.state(probes) != moved.state(probes + shift)
    assert differ.sum() <= 1e-4 * (m.state(probes) != UNKNOWN).sum()


def test_a_map_without_measurements_is_unknown(method: str) -> None:
    m = create_map(Config(0.1, method), CAMERA)
    m.add_keyframe(np.full(CAMERA.shape, np.nan, np.float32), np.eye(4), CAMERA)
    assert m.state([[0.0, 0.0, 1.0]])[0] == UNKNOWN
    assert len(m.voxels(0.0)[0]) == 0


def test_bad_input_is_refused_and_changes_nothing(method: str) -> None:
    m = build(method, [0])
    with pytest.raises(KeyframeError, match=r"shape \(10, 10\)"):
        m.add_keyframe(np.ones((10, 10), np.float32), np.eye(4), CAMERA)
    with pytest.raises(KeyframeError, match="floating-point metres, not uint16"):
        m.add_keyframe(np.ones(CAMERA.shape, np.uint16), np.eye(4), CAMERA)
    with pytest.raises(KeyframeError, match="pose"):
        m.add_keyframe(np.ones(CAMERA.shape, np.float32), np.ones((4, 4)), CAMERA)
    for act in (
        lambda: m.remove_keyframe(7),
        lambda: m.move_keyframe(7, np.eye(4)),
        lambda: m.infer(keyframes=[7]),
    ):
        with pytest.raises(KeyframeError, match="no keyframe 7"):
            act()
    (first,) = m.keyframes
    with pytest.raises(KeyframeError, match="pose"):
        m.move_keyframe(first, np.ones((4, 4)))
    assert not m.stale
    assert_same_map(m, build(method, [0]))


def test_a_loaded_map_is_the_saved_one_and_goes_on(method: str, tmp_path: Path) -> None:
    m = build(method, [0, 1])
    m.save(tmp_path / "map.npz")
    loaded = load_map(tmp_path / "map.npz")
    assert isinstance(loaded, METHODS[method])
    assert loaded.config == m.config
    assert [k.name for k in loaded.keyframes.values()] == [k.name for k in m.keyframes.values()]
    assert_same_map(loaded, m)
    for each in (m, loaded):
        (first, *_) = each.keyframes
        add(each, 2)
        each.remove_keyframe(first)
        each.infer()
    assert list(loaded.keyframes) == list(m.keyframes)
    assert_same_map(loaded, m)


def test_a_stale_map_is_stale_when_it_comes_back(method: str, tmp_path: Path) -> None:
    m = build(method, [0, 1])
    (first, *_) = m.keyframes
    m.remove_keyframe(first)
    m.save(tmp_path / "map.npz")
    loaded = METHODS[method].load(tmp_path / "map.npz")
    assert loaded.stale
    np.testing.assert_array_equal(loaded.occupancy(small_room.probes()), m.occupancy(small_room.probes()))
    loaded.infer()
    assert_same_map(loaded, build(method, [1]))


def test_a_map_of_another_method_says_what_it_is(tmp_path: Path) -> None:
    paths = {name: tmp_path / f"{name}.npz" for name in ("mrf", *METHODS)}
    for name, path in paths.items():
        create_map(Config(0.1, name), CAMERA).save(path)  # type: ignore[arg-type]
    with pytest.raises(MapFileError, match=r"'log_odds', which LogOddsMap\.load reads, not MRFMap\.load"):
        MRFMap.load(paths["log_odds"])
    with pytest.raises(MapFileError, match=r"'mrf', which MRFMap\.load reads, not LogOddsMap\.load"):
        LogOddsMap.load(paths["mrf"])
    with pytest.raises(MapFileError, match=r"'visibility', which VisibilityMap\.load reads"):
        LogOddsMap.load(paths["visibility"])
    assert isinstance(load_map(paths["mrf"]), MRFMap)


def test_an_older_map_that_names_no_method_is_an_mrf_map(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    MRFMap(0.1).save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in ("method", MANIFEST)}
    np.savez(path, **{**arrays, "format": np.asarray(1)})
    assert isinstance(load_map(path), MRFMap)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("belief", None, "belief is missing"),
        ("belief", np.zeros((1, 512), np.float32), r"belief is float32 \(1, 512\); expected \(\d+, 512\)"),
        ("method", np.asarray("magic"), "method .magic., which is not registered"),
        ("format", np.asarray(99), "format 99, by a newer version; this version reads formats 1 to 4"),
    ],
)
def test_a_damaged_map_is_refused(tmp_path: Path, name: str, value: np.ndarray | None, message: str) -> None:
    path = tmp_path / "map.npz"
    build("log_odds", [0]).save(path)
    with np.load(path) as file:
        arrays = {each: file[each] for each in file.files if each not in (name, MANIFEST)}
    if value is not None:
        arrays[name] = value
    write_npz(path, arrays, manifest=True)
    with pytest.raises(MapFileError, match=message) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
