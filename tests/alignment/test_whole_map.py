"""A recording is found in a whole map, or refused: another place, too little seen, or two that look alike."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from two_days import CAMERA, CONFIG, SIGMA_M, TODAY, YESTERDAY, room_frames, turned_away

import taichi_mrf as tm
from taichi_mrf.alignment.locate_recording import LocatedRecording, locate_stretch
from taichi_mrf.alignment.scan import Scan, scan_of
from taichi_mrf.alignment.whole_map import map_of_voxels, walls_of
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.geometry.poses import Pose, inverse, look_at, tangent_norms
from taichi_mrf.mapping.onto import locate, whole_map
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")

NOISE = PolynomialNoise((SIGMA_M,))


def map_of(frames: Sequence[Frame], color: bool = False) -> MRFMap:
    m = MRFMap.from_config(replace(CONFIG, color=color), CAMERA)
    for frame in frames:
        m.add(frame)
    m.infer()
    return m


def shot(scene: Scene, poses: Sequence[Pose]) -> list[Frame]:
    frames = []
    for index, T in enumerate(poses):
        depth_m = ray_depths(scene, CAMERA, T).astype(np.float32)
        frames.append(Frame(depth_m, T, CAMERA, float(index), f"shot {index}"))
    return frames


def stretch_of(frames: Sequence[Frame], T_away: Pose) -> Scan:
    moved = [replace(frame, T_world_camera=T_away @ frame.T_world_camera) for frame in frames]
    return scan_of(moved, CONFIG.sensor, NOISE)


def painted(frames: Sequence[Frame], brightness: Callable[[np.ndarray], np.ndarray]) -> list[Frame]:
    """Frames that see walls as bright (0 to 1) as their points (..., 3) in the world are."""
    found = []
    for frame in frames:
        R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
        bright = brightness((CAMERA.rays() * frame.depth_m[..., None]) @ R.T + t)
        found.append(replace(frame, color=np.repeat((50 + 200 * bright).astype(np.uint8)[..., None], 3, -1)))
    return found


def located(m: MRFMap, frames: Sequence[Frame], T_away: Pose) -> LocatedRecording:
    return locate_stretch(stretch_of(frames, T_away), whole_map(m))


def around(count: int, radius_m: float = 0.5) -> list[Pose]:
    """Poses on a circle, level, that look outwards."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [(radius_m * np.cos(a), radius_m * np.sin(a), 0.0) for a in angles]
    return [look_at(place, (4 * place[0], 4 * place[1], -0.3)) for place in places]


def box_room(length: float, width: float, *more: Solid, height: float = 2.4) -> Scene:
    """An empty room around the origin."""
    top = height / 2 + 0.1
    walls = [Solid("box", (side * (length / 2 + 0.1), 0, 0), (0.1, width, top)) for side in (-1, 1)] + [
        Solid("box", (0, side * (width / 2 + 0.1), 0), (length, 0.1, top)) for side in (-1, 1)
    ]
    levels = [Solid("box", (0, 0, side * top), (length, width, 0.1)) for side in (-1, 1)]
    return Scene((*walls, *levels, *more), (0.0, 0.0, 1.0))


@pytest.fixture(scope="module")
def yesterday(one_backend: str) -> MRFMap:
    return map_of([room_frames()[index] for index in YESTERDAY])


@pytest.mark.parametrize("first", [0, 4, 9])
def test_a_stretch_of_another_day_is_found_where_it_was_taken(yesterday: MRFMap, first: int) -> None:
    frames = [room_frames()[index] for index in TODAY[first : first + 6]]
    T_today_room = turned_away(first)
    found = located(yesterday, frames, T_today_room)
    assert found.T_map_recording is not None, found.reason
    for frame in frames:
        T_found = found.T_map_recording @ T_today_room @ frame.T_world_camera
        turned_rad, shifted_m = tangent_norms(frame.T_world_camera, T_found)
        assert shifted_m < 0.02
        assert np.degrees(turned_rad) < 0.5
        assert shifted_m < 3 * found.sigma_m
    assert found.overlap > 0.9
    assert found.agreement > 0.9
    assert found.through < 0.02
    assert found.in_words().endswith("% of what is seen agrees")


def test_the_covariance_is_that_of_the_middle_camera(yesterday: MRFMap) -> None:
    """Where the camera stands does not depend on the world in which it was recorded, nor does its sigma."""
    frames = [room_frames()[index] for index in TODAY[:6]]
    one, other = (located(yesterday, frames, turned_away(seed)) for seed in (1, 2))
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=0.05, atol=1e-7)
    assert (np.linalg.eigvalsh(one.covariance) > 0).all()
    assert 1e-4 < one.sigma_m < 0.1


def test_another_room_is_refused(yesterday: MRFMap) -> None:
    scene = box_room(5.0, 4.0, Solid("box", (1.2, 0.3, -0.9), (0.4, 0.6, 0.3)))
    found = located(yesterday, shot(scene, around(8)), turned_away())
    assert found.T_map_recording is None
    assert found.reason.startswith("another place")
    assert np.isinf(found.covariance).all()


def test_the_voxels_of_a_map_show_walls_and_where_cameras_may_be(yesterday: MRFMap) -> None:
    """Where the marginals are, as in a map in chunks; a stretch is found there, another room is not."""
    whole = map_of_voxels(yesterday)
    planes = whole.surface.planes()
    voxel_m = CONFIG.voxel_size
    ahead = yesterday.marginals.state(planes.points_m + 2 * voxel_m * planes.normals)
    assert (ahead == tm.FREE).mean() > 0.9
    assert (yesterday.marginals.state(whole.cameras_m) == tm.FREE).all()
    assert len(whole.walls.cells) == len(planes.cells)
    for first in (0, 4, 9):
        frames = [room_frames()[index] for index in TODAY[first : first + 6]]
        T_away = turned_away(first)
        found = locate_stretch(stretch_of(frames, T_away), whole)
        assert found.T_map_recording is not None, found.reason
        middle = frames[3].T_world_camera
        turned_rad, shifted_m = tangent_norms(middle, found.T_map_recording @ T_away @ middle)
        assert shifted_m < voxel_m
        assert np.degrees(turned_rad) < 2
    scene = box_room(5.0, 4.0, Solid("box", (1.2, 0.3, -0.9), (0.4, 0.6, 0.3)))
    found = locate_stretch(stretch_of(shot(scene, around(8)), turned_away()), whole)
    assert found.reason.startswith("another place")


CUPBOARD = Solid("box", (2.0, 0.6, -0.6), (0.3, 0.6, 0.6))
"""At one end of a room, as high as most views look: a lower desk is seen by few of them."""


def test_an_empty_room_looks_alike_from_two_sides() -> None:
    scene = box_room(5.0, 3.4)
    m = map_of(shot(scene, around(12)))
    found = located(m, shot(scene, around(8, 0.4)), turned_away())
    assert found.T_map_recording is None
    assert found.reason.startswith("two places look alike")
    assert len(found.places) == 2
    turned_rad, _ = tangent_norms(*found.places)
    assert np.degrees(turned_rad) == pytest.approx(180, abs=3)
    # What stands at one end tells them apart.
    furnished = box_room(5.0, 3.4, CUPBOARD)
    m = map_of(shot(furnished, around(12)))
    frames, T_away = shot(furnished, around(8, 0.4)), turned_away()
    found = located(m, frames, T_away)
    assert found.T_map_recording is not None, found.reason
    assert tangent_norms(found.T_map_recording @ T_away, np.eye(4))[1] < 0.03


def test_colours_tell_two_sides_of_an_empty_room_apart() -> None:
    scene, one_wall_bright = box_room(5.0, 3.4), lambda points: np.where(points[..., 0] > 1.0, 1.0, 0.3)
    yesterday_s, today_s = shot(scene, around(12)), shot(scene, around(8, 0.4))
    today, T_away = painted(today_s, one_wall_bright), turned_away()
    m = map_of(painted(yesterday_s, one_wall_bright), color=True)
    found = located(m, today, T_away)
    assert found.T_map_recording is not None, found.reason
    assert tangent_norms(found.T_map_recording @ T_away, np.eye(4)) < (0.03, 0.03)
    assert found.colors > 0.9
    # Unless both have them, they count for nothing.
    for frames, of in ((today_s, m), (today, map_of(yesterday_s))):
        found = located(of, frames, T_away)
        assert found.reason.startswith("two places look alike")
        assert found.to_json()["colors"] is None


def test_a_room_of_the_same_shape_in_other_colours_is_refused() -> None:
    scene = box_room(5.0, 3.4, CUPBOARD)
    m = map_of(painted(shot(scene, around(12)), lambda points: (points[..., 2] > 0) * 1.0), color=True)
    today = shot(scene, around(8, 0.4))
    found = located(m, painted(today, lambda points: (points[..., 2] < 0) * 1.0), turned_away())
    assert found.T_map_recording is None
    assert "its colours are not those of the map (correlation -" in found.reason
    # A lamp that is dimmed changes no mind.
    dim = painted(today, lambda points: 0.2 + 0.2 * (points[..., 2] > 0))
    assert located(m, dim, turned_away()).T_map_recording is not None


def test_in_a_hall_a_stretch_is_found_further_from_the_cameras() -> None:
    """More than 5 m aside of all cameras of the map, which is searched as far as the stretch sees."""
    corner, block = Solid("box", (7, 5, 0), (2.5, 2, 3)), Solid("box", (-1, -5, -2), (2, 1.5, 2))
    hall, poses, shift = box_room(14.0, 11.0, corner, block, height=6.0), around(12), np.zeros((4, 4))
    shift[:2, 3] = 3.2, 0.5
    m = map_of(shot(hall, [T - shift for T in poses]))
    frames, T_away = shot(hall, [T + 1.2 * shift for T in poses[::2]]), turned_away()
    assert stretch_of(frames, T_away).lever_m > 4.8
    found = located(m, frames, T_away)
    assert found.T_map_recording is not None, found.reason
    assert tangent_norms(found.T_map_recording @ T_away, np.eye(4))[1] < 0.05


def test_a_wall_alone_is_too_little() -> None:
    scene = Scene((Solid("box", (3.0, 0, 0), (0.1, 30.0, 30.0)),), (0.0, 0.0, 1.0))
    poses = [look_at((0.0, 0.1 * k, 0.0), (3.0, 0.1 * k, 0.0)) for k in range(6)]
    found = located(map_of(shot(scene, poses)), shot(scene, poses), turned_away())
    assert found.T_map_recording is None
    assert found.reason.startswith(("too little seen", "two places look alike"))


def test_a_few_views_are_too_little(yesterday: MRFMap) -> None:
    """They fit, and so would a corridor's end."""
    frames = [room_frames()[index] for index in TODAY[:5]]
    assert located(yesterday, frames, turned_away()).T_map_recording is not None
    assert (
        located(yesterday, frames[:4], turned_away()).reason == "too little seen: 4 views, but 5 are needed"
    )


def test_images_without_smooth_surfaces_are_too_little(yesterday: MRFMap) -> None:
    blank = [Frame(np.zeros(CAMERA.shape, np.float32), np.eye(4), CAMERA, 0.0, "blank")] * 3
    assert located(yesterday, blank, np.eye(4)).reason.startswith("too little seen")
    assert locate(yesterday, blank).reason.startswith("too little seen")


def test_walls_are_what_two_keyframes_have_measured() -> None:
    poses = [look_at((0.0, y, 0.0), (3.0, y, 0.0)) for y in (0.0, 1.0)]
    frames = shot(box_room(6.0, 12.0), poses)
    m = map_of(frames)
    whole = whole_map(m)
    points = [m.aligner.surface.of([id]) for id in m.keyframes]
    shared = np.intersect1d(points[0].keys, points[1].keys)
    expected = whole.surface.chosen(np.isin(whole.surface.keys, shared)).planes()
    np.testing.assert_array_equal(whole.walls.cells, expected.cells)
    assert 0 < len(whole.walls.cells) < len(whole.surface.planes().cells)
    assert len(walls_of(points[0], points[:1]).cells) == 0


def test_a_recording_is_found_by_a_later_stretch_if_it_begins_elsewhere(yesterday: MRFMap) -> None:
    """The first frames are of another room, as if a door was passed."""
    T, beside = turned_away(3), np.eye(4)
    beside[0, 3] = 8.0
    elsewhere = [
        Frame(f.depth_m, T @ beside @ f.T_world_camera, CAMERA, f.stamp, f"elsewhere {k}")
        for k, f in enumerate(shot(box_room(5.0, 4.0), around(12)))
    ]
    here = [room_frames()[index] for index in TODAY]
    frames = elsewhere + [Frame(f.depth_m, T @ f.T_world_camera, CAMERA, f.stamp, f.name) for f in here]
    found = locate(yesterday, frames)
    assert found.T_map_recording is not None, found.reason
    assert tangent_norms(found.T_map_recording, inverse(T))[1] < 0.05
    assert found.frames[-1].startswith("frame")
    assert locate(yesterday, elsewhere).T_map_recording is None
