"""Views of a live run beside its map: rays, images of a view, and OctoMap's way with the same frames."""

import re
from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_room
from live_scene import CONFIG, FakeLink, finished, map_voxels, room, session_of, shown
from plugged_noise import PixelNoise

from taichi_mrf.config.schema import Config
from taichi_mrf.methods.map_file import StoredKeyframe
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.session.ray_answers import pixel_answer
from taichi_mrf.viewer.messages import Images, Notice, PixelRay, RayAnswer, RayThrough, Switch, Votes, Watch

pytestmark = pytest.mark.usefixtures("one_backend")


def test_a_pixels_ray_has_its_measurement_along_the_ray() -> None:
    link = FakeLink()
    session = session_of(link, room(2))
    m = finished(session)
    frame = small_room.frames()[1]
    u, v = 15, 75
    link.ask(PixelRay(1, float(u), float(v)))
    finished(session)
    (answer,) = link.of_type(RayAnswer)
    slant = frame.camera.range_per_depth()[v, u]
    depth = frame.depth_m[v, u]
    assert depth > 0
    assert answer.measured_m == pytest.approx(depth * slant)
    sigma, bias = m.noise.table(frame.camera).at_pixels(frame.depth_m)
    assert answer.sigma_m == pytest.approx(sigma[v, u] * slant)
    assert answer.bias_m == pytest.approx(bias[v, u] * slant)
    towards = frame.T_world_camera[:3, :3] @ frame.camera.rays()[v, u]
    np.testing.assert_allclose(answer.direction, towards / np.linalg.norm(towards), atol=1e-6)
    profile = m.ray_profile(frame.T_world_camera[:3, 3], towards)
    np.testing.assert_array_equal(answer.omega, profile.omega)
    assert abs(answer.distance[np.argmax(answer.omega)] - answer.measured_m) < 2 * m.voxel_size


def test_a_click_is_answered_with_the_noise_of_another_package() -> None:
    u, v = 15, 7
    sigma_m = np.full((9, 20), 0.01, np.float32)
    sigma_m[v, u] = 0.03
    camera = PinholeCamera(20, 9, 10.0, 10.0, 9.5, 4.0)
    image = StoredKeyframe(0, "one", np.full((9, 20), 2.0, np.float32), np.eye(4), camera, 0.0)
    no_profile = SimpleNamespace(distance=0, length=0, occupancy=0, visibility=0, omega=0)
    m: Any = SimpleNamespace(noise=PixelNoise(sigma_m), ray_profile=lambda *_: no_profile)
    answer = pixel_answer(m, image, float(u), float(v))
    slant = np.sqrt(1 + 0.55**2 + 0.3**2)
    assert answer.measured_m == pytest.approx(2.0 * slant)
    assert (answer.sigma_m, answer.bias_m) == (pytest.approx(0.03 * slant), 0.0)


def test_a_ray_through_a_point_is_that_of_a_keyframe_that_sees_it() -> None:
    link = FakeLink()
    session = session_of(link)
    finished(session)
    frame = small_room.frames()[2]
    u, v = 52, 67
    depth = float(frame.depth_m[v, u])
    point = (frame.T_world_camera @ np.append(frame.camera.rays()[v, u] * depth, 1.0))[:3]
    eye = (0.0, 0.0, 1.0)
    behind = tuple((frame.T_world_camera @ [0.0, 0.0, -50.0, 1.0])[:3])
    for click in (
        RayThrough(tuple(point), eye, 2),
        RayThrough(tuple(point), eye, None),
        RayThrough(behind, eye, 2),
    ):
        link.ask(click)
        finished(session)
    wanted, nearest, from_eye = link.of_type(RayAnswer)
    assert wanted.title == f"{frame.name}, pixel ({u}, {v})"
    assert wanted.measured_m == pytest.approx(np.linalg.norm(point - frame.T_world_camera[:3, 3]), rel=1e-5)
    assert nearest.measured_m is not None
    assert from_eye.measured_m is None
    assert from_eye.origin == eye


def test_what_keyframes_say_of_a_voxel_adds_up_to_its_log_odds() -> None:
    link = FakeLink()
    session = session_of(link)
    m = finished(session)
    points, _ = m.marginals.voxels(0.5)
    for point in points[:: len(points) // 5]:
        link.ask(RayThrough(tuple(point.tolist()), (0.0, 0.0, 1.0), None))
        finished(session)
        answer = link.of_type(Votes)[-1]
        assert answer.known
        assert answer.point == tuple(point)
        strengths = [abs(log_odds) for _, log_odds in answer.votes]
        assert strengths == sorted(strengths, reverse=True)
        p = m.marginals.occupancy([point])[0]
        total = m.view.pool.prior_log_odds + sum(log_odds for _, log_odds in answer.votes)
        assert total == pytest.approx(np.log(p / (1 - p)), abs=0.02)  # messages are float16
    strongest = answer.votes[0][0]
    link.ask(Switch(strongest, False))
    link.ask(RayThrough(answer.point, (0.0, 0.0, 1.0), None))
    finished(session)
    assert strongest not in dict(link.of_type(Votes)[-1].votes)


def test_images_of_a_view_are_small_and_scored() -> None:
    link = FakeLink()
    session = session_of(link, room(2))
    link.ask(Watch(images=True, view=None, baseline=False))
    finished(session)
    images = link.of_type(Images)
    assert images[0].title == small_room.frames()[0].name
    for image in (images[0].measured, images[0].rendered, images[0].accuracy):
        assert image.shape == (90, 120, 3)
        assert image.dtype == np.uint8
    assert re.match(r"\d+% right within 1.5 sigma, \d+% without a surface", images[0].score)


@pytest.mark.parametrize("kept", [{}, {"color": True, "keep_surface": True}])
def test_octomaps_way_follows_the_keyframes_and_goes_away_again(kept: dict[str, Any]) -> None:
    def beside() -> set[tuple[int, int, int]]:
        return shown(link.sent).voxels("baseline")

    def log_odds_voxels(chosen: Iterable[int]) -> set[tuple[int, int, int]]:
        config = Config(voxel_size=CONFIG.voxel_size, method="log_odds")
        m = create_map(config, small_room.frames()[0].camera)
        for i in chosen:
            small_room.add(m, small_room.frames()[i])
        return map_voxels(m)

    link = FakeLink()
    session = session_of(link, config=replace(CONFIG, **kept))
    link.ask(Watch(images=False, view=None, baseline=True))
    finished(session)
    assert [notice for notice in link.of_type(Notice) if notice.severity == "error"] == []
    assert beside() == log_odds_voxels(range(4))
    link.ask(Switch(1, on=False))
    finished(session)
    assert beside() == log_odds_voxels([0, 2, 3])
    link.ask(Watch(images=False, view=None, baseline=False))
    finished(session)
    assert shown(link.sent).bricks["baseline"] == {}
