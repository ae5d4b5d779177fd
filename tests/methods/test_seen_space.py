"""Bricks without voxels are free only where rays have seen most of them: what is solid is not free for a ray
that cut a corner, and two walks through one room find nothing changed."""

from collections.abc import Sequence

import numpy as np
import pytest

import taichi_mrf as tm
from taichi_mrf.datasets.synthetic.room_furniture import room_scene
from taichi_mrf.queries.changed_things import things_between
from taichi_mrf.queries.points import FREE

pytestmark = pytest.mark.usefixtures("one_backend")

ROOM = "synthetic:room?frames=30&width=160&height=120"


def mapped(frames: Sequence[int], voxel_size: float) -> tm.MRFMap:
    dataset, m = tm.open_dataset(ROOM), tm.MRFMap(voxel_size=voxel_size)
    for index in frames:
        m.add(dataset.read(index))
    m.infer()
    return m


def test_hardly_any_inside_of_a_solid_is_free() -> None:
    voxel_m = 0.05
    m = mapped(range(0, 30, 2), voxel_m)
    sides = [np.arange(low, high, voxel_m) for low, high in ((-3.2, 3.4), (-3.0, 2.8), (-1.5, 1.7))]
    centres_m = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3) + voxel_m / 2
    free, height_m = np.asarray(m.state(centres_m)) == FREE, room_scene().signed_distance(centres_m)
    assert free[height_m > voxel_m].mean() > 0.7
    assert free[height_m < -voxel_m].mean() < 0.015


@pytest.mark.parametrize(
    ("first", "second", "voxel_m"),
    [(range(15), range(15, 30), 0.1), (range(0, 30, 3), range(1, 30, 3), 0.05)],
)
def test_two_walks_through_one_room_find_nothing_changed(first: range, second: range, voxel_m: float) -> None:
    """Also where few rays of one keyframe say "occupied", and one ray at a slant says "free"."""
    a, b = mapped(first, voxel_m), mapped(second, voxel_m)
    assert things_between(tm.compare_maps(a, b), a, b) == []
    assert things_between(tm.compare_maps(b, a), b, a) == []
