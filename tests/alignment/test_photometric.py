"""Colour in alignment: contrast, its residuals and their derivatives, against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray
from patterned_wall import AHEAD, CAMERA, wall

from taichi_mrf.alignment.contrast import ContrastImage, TexturedPoints, contrast_images
from taichi_mrf.alignment.keyframe_pictures import KeyframePictures
from taichi_mrf.alignment.photometric import Photometric
from taichi_mrf.alignment.se3 import moved, twist
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.frame import Frame

# Written out, and not imported: these tests hold the values.
LEAST_SLOPE = 0.02
COLOR_SIGMA_RAD = 0.0005
ENOUGH_POINTS = 200
LARGEST_COST = 4.685**2 / 6
TUKEY = 4.685

TWIST = np.array([0.01, -0.015, 0.02, 0.008, -0.012, 0.015])


def waves(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.2 * np.sin(u / 15 + 0.4) * np.cos(v / 18 - 0.3)


@pytest.fixture
def smooth() -> tuple[ContrastImage, TexturedPoints]:
    """An image in closed form, and points whose contrast departs from it a little, some by far."""
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    slopes = np.stack(
        [
            0.2 / 15 * np.cos(u / 15 + 0.4) * np.cos(v / 18 - 0.3),
            -0.2 / 18 * np.sin(u / 15 + 0.4) * np.sin(v / 18 - 0.3),
        ],
        axis=-1,
    )
    image = ContrastImage(
        CAMERA,
        waves(u, v).astype(np.float32),
        slopes.astype(np.float32),
        np.zeros(CAMERA.shape, np.float32),
        np.ones(CAMERA.shape, bool),
    )
    random = np.random.default_rng(0)
    at = random.uniform((10, 10), (150, 110), (400, 2))
    points = CAMERA.directions(at[:, 0], at[:, 1]) * random.uniform(0.8, 3.0, (400, 1))
    contrast = waves(*at.T) + random.normal(0, 0.02, 400) + np.where(random.random(400) < 0.1, 0.5, 0)
    world = points @ AHEAD[:3, :3].T + AHEAD[:3, 3]
    return image, TexturedPoints(world.astype(np.float32), contrast.astype(np.float32))


def test_the_cost_is_that_of_the_closed_form_and_its_slope_the_gradient(
    smooth: tuple[ContrastImage, TexturedPoints],
) -> None:
    image, points = smooth
    T = moved(AHEAD, 0.3 * TWIST)
    found = Photometric(image, points.points.astype(np.float64), points.contrast.astype(np.float64), 0.03)

    def cost(at: Pose) -> float:
        p = (points.points - at[:3, 3]) @ at[:3, :3]
        u, v = CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx, CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy
        r = waves(u, v) - points.contrast
        return float(LARGEST_COST * (1 - np.maximum(0, 1 - (r / (TUKEY * 0.03)) ** 2) ** 3).sum())

    here = found.linearised(T)
    assert here.cost == pytest.approx(cost(T), rel=2e-3)
    step = 1e-4
    slope = [(cost(moved(T, step * e)) - cost(moved(T, -step * e))) / (2 * step) for e in np.eye(6)]
    np.testing.assert_allclose(here.g, slope, rtol=0.02, atol=0.01 * np.abs(slope).max())
    # H is that of Gauss and Newton: its curvature along each axis is that of residuals that change by J.
    assert np.linalg.eigvalsh(here.H)[0] > 0
    np.testing.assert_allclose(here.H, here.H.T)


def test_all_points_together_are_one_measurement_of_the_direction(
    smooth: tuple[ContrastImage, TexturedPoints],
) -> None:
    image, points = smooth

    def first(count: int) -> Photometric | None:
        some = TexturedPoints(points.points[:count], points.contrast[:count])
        return Photometric.seen_from(image, some, AHEAD)

    full, few = first(400), first(ENOUGH_POINTS // 2)
    assert full is not None
    assert few is not None
    turns = [np.trace(each.linearised(AHEAD).H[3:5, 3:5]) * COLOR_SIGMA_RAD**2 for each in (full, few)]
    assert turns[0] == pytest.approx(0.9, abs=0.05)  # a tenth looks different
    assert turns[1] == pytest.approx(0.9 / 2, abs=0.05)
    assert first(19) is None


def test_points_on_one_line_do_not_count(smooth: tuple[ContrastImage, TexturedPoints]) -> None:
    image, points = smooth
    across = AHEAD[:3, 3] + AHEAD[:3, 2] + np.linspace(-0.5, 0.5, 400)[:, None] * AHEAD[:3, 0]
    line = Photometric.seen_from(image, TexturedPoints(across.astype(np.float32), points.contrast), AHEAD)
    assert line is not None
    assert line.worth == 0
    assert not line.linearised(AHEAD).H.any()


def test_a_textured_wall_gives_the_pose_back() -> None:
    pictures = KeyframePictures()
    pictures.keep(3, wall(AHEAD))
    T_true = moved(AHEAD, TWIST)
    keyframes = {3: type("Posed", (), {"T_world_camera": AHEAD})()}
    levels = pictures.compared_with(wall(T_true, gain=1.25), keyframes, AHEAD)
    T = AHEAD
    for level in levels:
        for _ in range(12):
            seen = level.seen_from(T)
            assert seen is not None
            here = seen.linearised(T)
            T = moved(T, np.linalg.solve(here.H, -here.g))
    off = twist(inverse(T_true) @ T)
    assert np.abs(off[:3]).max() < 0.003
    assert np.abs(off[3:]).max() < 0.002
    assert pictures.compared_with(wall(T_true), {}, AHEAD) == []


def test_exposure_does_not_change_contrast_and_plain_paint_has_none() -> None:
    (_, normal), (_, bright) = contrast_images(wall(AHEAD)), contrast_images(wall(AHEAD, gain=1.5))
    inside = normal.usable
    assert np.abs(normal.contrast[inside]).max() > 0.2
    # DARK and rounding are what is left.
    assert np.abs(normal.contrast - bright.contrast)[inside].mean() < 0.05 * np.abs(normal.contrast).mean()
    frame = wall(AHEAD)
    plain = np.full((*CAMERA.shape, 3), 90, np.uint8)
    plain[30:60, 40:80] = 0  # no colour there, which is no edge
    for image in contrast_images(Frame(frame.depth_m, AHEAD, CAMERA, 0.0, "plain", plain)):
        assert np.abs(image.contrast).max() < LEAST_SLOPE / 10
        assert len(image.textured_points().points) == 0
    assert contrast_images(Frame(frame.depth_m, AHEAD, CAMERA, 0.0, "none")) == []


def test_points_lie_on_the_wall_and_not_at_its_edges() -> None:
    frame = wall(AHEAD)
    depth_m = frame.depth_m.copy()
    depth_m[:, 80:] += 1.0
    for image in contrast_images(Frame(depth_m, AHEAD, CAMERA, 0.0, "step", frame.color)):
        found = image.textured_points()
        assert len(found.points) > 100
        seen = image.camera.project(found.points.astype(np.float64))
        edge = 80 * image.camera.fx / CAMERA.fx
        assert (np.abs(seen[:, 0] - edge + 0.5) > 1).all()
        rows, columns = seen[:, 1].round().astype(int), seen[:, 0].round().astype(int)
        np.testing.assert_array_equal(found.contrast, image.contrast[rows, columns])
