"""The bricks that keyframes see, followed from change to change."""

import numpy as np
import pytest
from small_room import VOXEL_SIZE, add, frames

from taichi_mrf.inference.keyframe import VisibleBricks
from taichi_mrf.methods.mrf.map import MRFMap


def same(found: VisibleBricks, wanted: VisibleBricks) -> bool:
    pairs = zip(vars(found).items(), vars(wanted).items(), strict=True)
    return all(name in ("arrays", "scale") or np.array_equal(a, b) for (name, a), (_, b) in pairs)


@pytest.mark.parametrize("seed", range(4))
def test_lists_that_follow_changes_are_those_made_anew(seed: int) -> None:
    """Bricks come and go, and come back in other slots, between one look at a list and the next."""
    m, random = MRFMap(VOXEL_SIZE), np.random.default_rng(seed)
    registry = m._parts.registry
    looks: dict[int, VisibleBricks] = {}
    merged = 0
    for _ in range(24):
        ids = sorted(m.keyframes)
        if len(ids) > 2 and random.random() < 0.45:
            m.remove_keyframe(int(random.choice(ids)))
        else:
            add(m, frames()[random.integers(len(frames()))])
        for id, keyframe in m.keyframes.items():
            now = registry.visible(keyframe.footprint)
            if id in looks and random.random() < 0.5:
                looks[id] = registry.visible_again(keyframe.footprint, before := looks[id])
                merged += looks[id] is not before
                assert same(looks[id], now)
            looks.setdefault(id, now)
    assert merged > 5
