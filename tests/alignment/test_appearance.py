"""Small pictures tell views of one place from views of others, and which keyframes share a view."""

import numpy as np
import pytest

from taichi_mrf.alignment.appearance import Appearances, small_picture
from taichi_mrf.alignment.joint import SharedViews
from taichi_mrf.datasets import open_dataset
from taichi_mrf.sensor.frame import Frame

pytestmark = pytest.mark.usefixtures("one_backend")


def around_the_room(count: int) -> list[Frame]:
    dataset = open_dataset(f"synthetic:room?width=160&height=120&frames={count}&noise=none")
    return [dataset.read(i) for i in range(count)]


def test_the_next_view_is_more_alike_than_all_others() -> None:
    frames = around_the_room(60)
    known = Appearances()
    for i in range(0, 60, 6):
        known.add(i, small_picture(frames[i].depth_m, frames[i].color))
    for i in range(0, 60, 6):
        for color in (frames[i + 1].color, None):
            likeness = known.likeness(small_picture(frames[i + 1].depth_m, color))
            assert max(likeness, key=likeness.__getitem__) == i
            assert likeness[i] > 0.5
    assert 0 not in known.like(0)
    assert known.like(0).keys() == {*range(6, 60, 6)}


def test_brightness_and_missing_depth_do_not_matter() -> None:
    frame = around_the_room(8)[3]
    assert frame.color is not None
    known = Appearances()
    known.add(0, small_picture(frame.depth_m, frame.color))
    holes = np.where(np.random.default_rng(0).random(frame.depth_m.shape) < 0.3, 0, frame.depth_m)
    changed = small_picture(holes.astype(np.float32), (0.5 * frame.color + 20).astype(np.uint8))
    assert known.likeness(changed)[0] > 0.98


def test_an_image_without_depth_or_contrast_is_like_nothing() -> None:
    frame = around_the_room(8)[0]
    known = Appearances()
    known.add(0, small_picture(frame.depth_m, frame.color))
    nothing = small_picture(np.zeros_like(frame.depth_m), np.full_like(frame.color, 7))
    assert not nothing.any()
    assert known.likeness(nothing) == {0: 0.0}
    assert Appearances().likeness(nothing) == {}


def test_partners_share_most_cells() -> None:
    views = SharedViews({0: np.arange(0, 10), 1: np.arange(5, 15), 2: np.arange(8, 18), 3: np.arange(90, 99)})
    mine = np.arange(5, 15)
    assert views.shares(mine) == {0: 0.5, 1: 1.0, 2: 0.7}
    assert views.partners(mine, most=2, least=0.1, without=1) == [2, 0]
    assert views.partners(mine, most=9, least=0.6, without=1) == [2]
