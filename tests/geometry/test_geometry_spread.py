"""Points in an order that spreads the first of them."""

import numpy as np

from taichi_mrf.geometry.spread import furthest_first


def test_each_point_is_the_furthest_from_those_before() -> None:
    draw = np.random.default_rng(0)
    points, taken = list(draw.uniform(size=(12, 3))), list(draw.uniform(size=(2, 3)))
    order = list(furthest_first(points, taken))
    assert sorted(order) == list(range(12))
    there = list(taken)
    for n, place in enumerate(order):
        apart = {i: min(np.linalg.norm(points[i] - each) for each in there) for i in order[n:]}
        assert apart[place] == max(apart.values())
        there.append(points[place])


def test_without_others_the_first_point_comes_first() -> None:
    line = [np.array([x]) for x in (5.0, 0.0, 4.0, 9.0)]
    assert list(furthest_first(line, [])) == [0, 1, 3, 2]
    assert list(furthest_first([], line)) == []
