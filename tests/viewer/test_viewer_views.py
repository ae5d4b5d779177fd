"""Views of the map from the page's buttons: what is seen fills the part of the window beside the panel."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from handled_page import HandledPage
from live_program import wait_for
from numpy.typing import NDArray
from raw_viewer_client import RawClient, camera_message, raw_client

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.scene.viewpoint import fitting_eye

HELLO = m.Hello("a recording", "cpu", "a device", "mrf", 0.1, -2.0, 0.1, "voxel_size: 0.1")
BRICKS = np.array([[x, y, z] for x in range(6) for y in range(4) for z in range(2)], np.int32)
"""4.8 m x 3.2 m x 1.6 m of occupied voxels."""
BOX_M = np.array([[0, 0, 0], [4.8, 3.2, 1.6]])
MIDDLE_M = np.array([2.4, 1.6, 0.8])


@pytest.fixture
def handled() -> Iterator[HandledPage]:
    running = HandledPage(Page, HELLO)
    take_box(running)
    yield running
    running.server.stop()


def take_box(running: HandledPage) -> None:
    """Show the box, and a speck far away from it."""
    running.page.viewpoint.set_up((2, 1))
    solid = np.full((len(BRICKS), 512), 900, np.int16), np.ones((len(BRICKS), 512), np.uint8)
    speck = np.full((1, 512), -900, np.int16)
    speck[0, 0] = 900  # one voxel, 80 m away
    running.take(m.Bricks("map", BRICKS, *solid, BRICKS[:0]))
    running.take(m.Bricks("map", np.array([[0, 100, 0]], np.int32), speck, solid[1][:1], BRICKS[:0]))
    running.page._flush()


def lens(browser: RawClient) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """The eye, the target, and the field of view that a browser is given."""
    eye = browser.hear_type("SetCameraPositionMessage", initial=False)["position"]
    target = browser.hear_type("SetCameraLookAtMessage", initial=False)["look_at"]
    return np.array(eye), np.array(target), browser.hear_type("SetCameraFovMessage", initial=False)["fov"]


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
@pytest.mark.parametrize(
    ("side", "across", "upwards", "towards"),
    [("Top", 0, 1, (0, 0, 1)), ("Front", 0, 2, (0, -1, 0)), ("Side", 1, 2, (1, 0, 0))],
)
def test_a_plan_fills_the_window_beside_the_panel(
    handled: HandledPage,
    width: int,
    height: int,
    side: str,
    across: int,
    upwards: int,
    towards: tuple[int, int, int],
) -> None:
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message(image_width=width, image_height=height))
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        handled.page.actions[side](next(iter(handled.server.get_clients())))
        eye, target, fov = lens(browser)
    away = eye - target
    distance = float(np.linalg.norm(away))
    assert away / distance == pytest.approx(np.array(towards), abs=2e-3)
    assert fov < np.deg2rad(10)  # the far side of the box is not much smaller than the near one
    assert abs(target @ towards - MIDDLE_M @ towards) < 0.1
    # The window at the box, in metres: the panel covers about 350 of 1280 pixels on the right.
    tall = 2 * np.tan(fov / 2) * distance
    wide = tall * width / height
    covered = 350 / 1280 if width > height else 0.0
    shown_m = np.array([wide * (1 - covered), tall])
    size_m = (BOX_M[1] - BOX_M[0])[[across, upwards]]
    assert 0.85 < (size_m / shown_m).max() < 1.0, "as large as it can be"
    sideways = np.cross((0, 0, 1) if side != "Top" else (0, 1, 0), towards)
    beside = (MIDDLE_M - eye) @ sideways
    assert beside == pytest.approx(-wide * covered / 2, abs=0.02 * wide), "in the middle of what is left"


def test_home_is_the_view_that_a_browser_opens_with(handled: HandledPage) -> None:
    start = handled.server.initial_camera
    opening = np.array(start.position), np.array(start.look_at), start.fov
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message(image_width=1280, image_height=800))
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        client = next(iter(handled.server.get_clients()))
        handled.page.actions["Top"](client)
        lens(browser)
        handled.page.actions["Home"](client)
        eye, target, fov = lens(browser)
        camera = handled.server.get_clients()[client].camera
        assert (camera.near, camera.far) == (0.01, 1000.0)
    np.testing.assert_allclose(eye, opening[0], atol=1e-6)
    np.testing.assert_allclose(target, opening[1], atol=1e-6)
    assert fov == pytest.approx(opening[2])


@pytest.mark.parametrize("covered", [0.0, 0.25])
@pytest.mark.parametrize("fov_deg", [5.0, 75.0])
def test_the_nearest_eye_that_sees_all_but_the_farthest_specks(covered: float, fov_deg: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform((-3, -1, 0), (5, 1, 2), (20_000, 3))
    specks = np.array([[900.0, 0.0, 0.0], [0.0, -700.0, 500.0]])
    fov, aspect = np.deg2rad(fov_deg), 1.5
    eye = fitting_eye(points, aspect, fov, covered)
    with_specks = fitting_eye(np.concatenate([points, specks]), aspect, fov, covered)
    np.testing.assert_allclose(with_specks, eye, rtol=0.01, atol=0.01)

    def places(z_m: float) -> NDArray[np.float64]:
        """Where the points are seen from there, from -1 to 1 in the window."""
        x, y, z = (points - (*eye[:2], z_m)).T
        return np.stack([x / (-z * aspect), y / -z], axis=1) / np.tan(fov / 2)

    seen = places(eye[2])
    inside = (np.abs(seen[:, 1]) < 1) & (seen[:, 0] > -1) & (seen[:, 0] < 1 - 2 * covered)
    assert inside.mean() > 0.99
    low, high = np.quantile(seen[:, 0], [0.005, 0.995])  # across, where these points are long
    assert high - low == pytest.approx(2 * (1 - covered), rel=0.1)
    assert high + low == pytest.approx(-2 * covered, abs=0.05)


def shown_shares(
    points: NDArray[np.float64], lens: tuple[NDArray[np.float64], NDArray[np.float64], float], aspect: float
) -> NDArray[np.float64]:
    """Where points (n, 3) are seen in the window, as shares (n, 2) from its lower left corner."""
    eye, target, fov = lens
    towards = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross((0, 0, 1), towards) / np.linalg.norm(np.cross((0, 0, 1), towards))
    x, y, z = np.stack([right, np.cross(towards, right), towards]) @ (points - eye).T
    return 0.5 + 0.5 * np.stack([x / (-z * aspect), y / -z], axis=1) / np.tan(fov / 2)


@pytest.mark.parametrize(("width", "height", "right", "foot"), [(1280, 800, 0.27, 0.1), (390, 844, 0, 0.45)])
@pytest.mark.parametrize("side", ["Home", "Top", "Side", "Fit"])
def test_what_is_seen_stands_above_what_covers_the_foot_of_the_window(
    handled: HandledPage, width: int, height: int, right: float, foot: float, side: str
) -> None:
    """The strip of time in a wide window, the open panel on a phone. *Home* is the first view here."""
    handled.take(replace(HELLO, has_dates=True))
    take_box(handled)
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message(image_width=width, image_height=height, position=[9, -5, 6]))
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        client = next(iter(handled.server.get_clients()))
        handled.page.actions[side](client)
        camera = handled.server.get_clients()[client].camera
        given = camera.position, camera.look_at, camera.fov
    places = shown_shares(handled.page.map.seen_points(), given, width / height)
    inside = ((places > (0, foot)) & (places < (1 - right, 1))).all(axis=1)
    assert inside.mean() > 0.98
    filled = np.ptp(places[inside], axis=0) / (1 - right, 1 - foot)
    assert filled.max() > 0.85


def test_home_is_the_opening_view_after_the_baseline_has_come_and_gone(handled: HandledPage) -> None:
    up, light = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
    handled.take(m.SurfaceView(np.array([-1.0, 9.2, 6.3]), MIDDLE_M, up, light, 0.7, False))
    start, homes = handled.server.initial_camera, []
    opening = np.array(start.position), np.array(start.look_at)
    one = BRICKS[:1], np.full((1, 512), 900, np.int16), np.ones((1, 512), np.uint8)
    with raw_client(handled.server.get_port()) as browser:
        browser.say(camera_message(image_width=1280, image_height=800))
        wait_for(lambda: len(handled.server.get_clients()) == 1, "the client")
        for change in ((*one, BRICKS[:0]), (BRICKS[:0], one[1][:0], one[2][:0], BRICKS[:1])):
            handled.take(m.Bricks("baseline", *change))
            handled.page.map.look_changed()
            handled.page._flush()
            client = next(iter(handled.server.get_clients()))
            handled.page.actions["Home"](client)
            camera = handled.server.get_clients()[client].camera
            homes.append((camera.position, camera.look_at))
    assert not np.allclose(homes[0], opening)  # both maps
    np.testing.assert_allclose(homes[1], opening, atol=1e-6)


def test_the_width_of_squares_is_told_by_the_panel_alone(handled: HandledPage) -> None:
    assert handled.server.scene.get_handle_by_name("/ground") is not None
    assert handled.server.scene.get_handle_by_name("/ground/square") is None
    handled.page.show_counts()
    assert "m squares" in handled.page.panel._shown.content


def test_a_gizmo_can_be_grasped_on_a_large_map(handled: HandledPage) -> None:
    T, crossed, picture = np.eye(4), np.zeros((0, 3), np.int32), np.zeros((2, 2, 3), np.uint8)
    camera = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
    handled.take(m.KeyframeInfo(0, "view", T, camera, 1, "on", picture, crossed, T))
    handled.page.actions["Move"](0)
    assert handled.page.keyframes.gizmo.scale == pytest.approx(0.05 * 81, rel=0.02)  # the speck is 80 m away
    low, high = BOX_M
    assert handled.page.keyframes.grab((low, high)).scale == 0.5


def test_a_single_voxel_can_be_looked_at() -> None:
    running = HandledPage(Page, HELLO)
    try:
        with raw_client(running.server.get_port()) as browser:
            browser.say(camera_message())
            wait_for(lambda: len(running.server.get_clients()) == 1, "the client")
            running.page.viewpoint.look_from(
                next(iter(running.server.get_clients())), "front", np.ones((1, 3))
            )
            eye, target, _ = lens(browser)
    finally:
        running.server.stop()
    assert target[1:] == pytest.approx([1, 1])
    assert eye[1] < 1.0


def test_a_hidden_map_is_not_fitted_but_the_keyframes_that_are_seen(
    handled: HandledPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, fitted = handled.page, []
    monkeypatch.setattr(page.viewpoint, "look_from", lambda client, side, points: fitted.append(points))
    crossed, picture = np.zeros((0, 3), np.int32), np.zeros((2, 2, 3), np.uint8)
    for id in range(2):
        T = np.eye(4)
        T[0, 3] = 50.0 + id
        camera = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
        handled.take(m.KeyframeInfo(id, "view", T, camera, 1, "on", picture, crossed, T))
    for name in ("map", "path", "keyframes"):
        page.panel.view_options.handles[name].value = False
        page._take_options()
        page._flush()
        page.actions["Fit"](0)
    assert len(fitted) == 2  # and nothing once the keyframes are hidden, too
    for points in fitted:
        np.testing.assert_array_equal(np.unique(points, axis=0), [[50.0, 0.0, 0.0], [51.0, 0.0, 0.0]])
