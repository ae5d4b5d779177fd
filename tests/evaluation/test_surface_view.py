"""The pictures of a surface, and its plan: its colours, its background and its borders."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.evaluation.pictures.room_views import (
    PHOTO_VOXEL_M,
    DrawnMap,
    DrawnSurface,
    smooth_borders,
    surface_view,
    top_view,
)
from taichi_mrf.evaluation.pictures.viewpoint import backdrop

pytestmark = pytest.mark.usefixtures("one_backend")

UP = np.array([0.0, 0.0, 1.0])
WHITE = np.full(3, 255, np.uint8)


def _steps(cells: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Squares of 1 m at z = 0, two triangles each, seen from above, for the True cells of a grid."""
    rows, columns = cells.shape
    number = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = (number[i : i + rows, j : j + columns][cells] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    x, y = np.divmod(np.arange(number.size), columns + 1)
    return np.stack([x, y, 0 * x], axis=1).astype(np.float64), triangles


def _drawn(voxel_size: float) -> tuple[NDArray[np.uint8], int]:
    """The picture of a white square by its own colours if voxels are small enough; the number of its axes."""
    vertices_m, triangles = _steps(np.ones((8, 8), bool))
    normals, colors = np.tile(UP, (len(vertices_m), 1)), np.tile(WHITE, (len(vertices_m), 1))
    figure = surface_view(DrawnSurface(vertices_m, triangles, normals, colors), voxel_size, UP)
    return np.asarray(figure.axes[0].images[0].get_array()), len(figure.axes)


@pytest.mark.parametrize("voxel_size", [PHOTO_VOXEL_M, 2.5 * PHOTO_VOXEL_M])
def test_photographs_color_small_voxels_alone(voxel_size: float) -> None:
    picture, axes = _drawn(voxel_size)
    middle = picture[tuple(np.array(picture.shape[:2]) // 2)].astype(int)
    grey = np.ptp(middle) < 3
    assert grey == (voxel_size <= PHOTO_VOXEL_M)
    assert axes == (1 if grey else 2), "a scale of heights where heights are shown"


def test_white_things_stand_out_from_the_background() -> None:
    picture, _ = _drawn(PHOTO_VOXEL_M)
    background = backdrop((picture.shape[0], picture.shape[1]))
    own = np.abs(picture.astype(int) - background).max(axis=-1) > 2
    assert 0.1 < own.mean() < 0.9
    assert (picture[own].astype(int).mean() - background.mean()) > 60
    assert background.max() < 140


def test_steps_at_a_border_become_a_slope() -> None:
    i, j = np.indices((12, 12))
    vertices_m, triangles = _steps(i >= j)
    smooth = smooth_borders(vertices_m, triangles)

    def roughness(of: NDArray[np.float64]) -> float:
        """How far the corners of the stairs lie from their common line."""
        stairs = [number for n in range(3, 9) for number in (n * 13 + n, n * 13 + n + 1)]
        return float(np.std(of[stairs, 0] - of[stairs, 1]))

    assert roughness(smooth) < 0.3 * roughness(vertices_m)
    inside = np.flatnonzero((vertices_m[:, 0] > vertices_m[:, 1] + 1) & (vertices_m[:, 0] < 12))
    inside = inside[vertices_m[inside, 1] > 0]
    np.testing.assert_array_equal(smooth[inside], vertices_m[inside])


def test_the_plan_shows_the_surface_and_no_ceiling() -> None:
    """A floor, and a ceiling of the same size that was seen from below; voxels are where neither is."""
    floor, up_facing = _steps(np.ones((8, 8), bool))
    vertices_m = np.concatenate([floor, floor + 3 * UP])
    triangles = np.concatenate([up_facing, up_facing[:, ::-1] + len(floor)])
    normals = np.concatenate([np.tile(UP, (len(floor), 1)), np.tile(-UP, (len(floor), 1))])
    room = DrawnMap(np.full((1, 3), 20.0), UP[None], 0.05, UP, [])
    axes = top_view(room, DrawnSurface(vertices_m, triangles, normals, None)).axes[0]
    assert axes.get_title() == "the measured surface from above, ceilings left out"
    picture = np.asarray(axes.images[0].get_array())
    left, right, bottom, top = axes.images[0].get_extent()
    assert (left, bottom) == pytest.approx((-0.3, -0.3), abs=0.05)
    assert (right, top) == pytest.approx((8.3, 8.3), abs=0.05)
    drawn = (picture < 255).any(axis=-1)
    edge = len(drawn) // 6
    assert drawn[edge:-edge, edge:-edge].all(), "the floor, without holes"
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2].astype(int)
    assert middle[2] > middle[1], "the colour of low things"


def test_the_plan_is_not_half_empty_for_what_was_seen_through_a_door() -> None:
    floor, triangles = _steps(np.ones((20, 20), bool))
    specks, of_speck = _steps(np.ones((1, 1), bool))
    vertices_m = np.concatenate([floor, specks + 60 * np.array([0.0, 1.0, 0.0])])
    triangles = np.concatenate([triangles, of_speck + len(floor)])
    room = DrawnMap(np.full((1, 3), 20.0), UP[None], 0.05, UP, [])
    surface = DrawnSurface(vertices_m, triangles, np.tile(UP, (len(vertices_m), 1)), None)
    axes = top_view(room, surface).axes[0]
    assert axes.images[0].get_extent()[2:] == pytest.approx((0, 20), abs=1.5)
