"""The triangle raster against every ray with every triangle, and the picture of a surface."""

import numpy as np
import pytest

from taichi_mrf.evaluation.pictures.raster import cast_triangles
from taichi_mrf.evaluation.pictures.room_views import DrawnSurface, surface_view
from taichi_mrf.evaluation.pictures.viewpoint import backdrop
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera

pytestmark = pytest.mark.usefixtures("one_backend")

CAMERA = PinholeCamera(width=37, height=29, fx=30.0, fy=26.0, cx=17.2, cy=15.1)


@pytest.mark.parametrize("seed", range(5))
def test_first_hits_and_their_places_are_exact(seed: int) -> None:
    """Also with triangles beside, behind and around the camera (Moeller and Trumbore 1997)."""
    rng = np.random.default_rng(seed)
    vertices, triangles = rng.uniform(-2, 2, (60, 3)), rng.integers(0, 60, (80, 3))
    pose = look_at(rng.uniform(-3, 3, 3), rng.uniform(-0.5, 0.5, 3), rng.normal(size=3))
    image = cast_triangles(vertices, triangles, CAMERA, pose)
    eye, forwards = pose[:3, 3], pose[:3, 2]
    ahead = ((vertices - eye) @ forwards > 0.01)[triangles].all(axis=1)
    a, b, c = vertices[triangles[ahead]].transpose(1, 0, 2)
    directions = CAMERA.rays().reshape(-1, 1, 3) @ pose[:3, :3].T
    across = np.cross(directions, c - a)
    volume = ((b - a) * across).sum(axis=-1)  # positive: seen from the front
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((eye - a) * across).sum(axis=-1) / volume
        beside = np.cross(eye - a, b - a)
        v = (directions * beside).sum(axis=-1) / volume
        depth = ((c - a) * beside).sum(axis=-1) / volume
    margin = np.minimum(np.minimum(u, v), 1 - u - v)
    front = volume > 0
    clear = ~(front & (np.abs(margin) < 1e-6)).any(axis=1)
    depth = np.where(front & (margin >= 0), depth, np.inf)
    nearest = depth.argmin(axis=1)
    hit = clear & np.isfinite(depth).any(axis=1)
    assert hit.any()
    found = image.index.reshape(-1)
    np.testing.assert_array_equal((found >= 0)[clear], hit[clear])
    np.testing.assert_array_equal(found[hit], np.flatnonzero(ahead)[nearest[hit]])
    rows = np.flatnonzero(hit)
    expected = np.stack([1 - u - v, u, v], axis=-1)[rows, nearest[rows]]
    np.testing.assert_allclose(image.shares.reshape(-1, 3)[rows], expected, atol=1e-5)
    np.testing.assert_allclose(image.depth_m.reshape(-1)[rows], depth[rows, nearest[rows]], rtol=1e-5)


@pytest.mark.parametrize("photo", [False, True])
def test_a_surface_is_drawn_in_its_colours_from_the_side_that_was_seen(photo: bool) -> None:
    """A level square, two triangles, seen from above."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], float)
    normals, red = np.tile([0.0, 0.0, 1.0], (4, 1)), np.tile(np.array([200, 30, 30], np.uint8), (4, 1))
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    up = np.array([0.0, 0.0, 1.0])
    for seen, faces in ((True, triangles), (False, triangles[:, ::-1])):
        figure = surface_view(DrawnSurface(vertices, faces, normals, red if photo else None), 0.01, up)
        picture = np.asarray(figure.axes[0].images[0].get_array())
        # The background is shaded; a surface is not like it.
        colored = (np.abs(picture.astype(int) - backdrop(picture.shape[:2])) > 8).any(axis=-1)
        assert colored.any() == seen
        if photo and seen:
            shade = np.median(picture[colored], axis=0) / red[0]
            assert shade[0] > 0.3
            np.testing.assert_allclose(shade, shade[0], atol=0.05)
        assert len(figure.axes) == (1 if photo else 2)  # a scale of heights, or none
