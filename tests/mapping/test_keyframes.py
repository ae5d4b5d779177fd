"""Keyframe selection against an oracle that measures the distances on its own."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.config.schema import KeyframeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.mapping.selection import KeyframeSelector


def pose(x: float = 0.0, yaw: float = 0.0) -> Pose:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[0, 3] = x
    return T


def selected(config: KeyframeConfig, poses: Sequence[Pose]) -> list[int]:
    """Indices of the poses that a selector takes."""
    selector, taken = KeyframeSelector(config), list[int]()
    for index, T_world_camera in enumerate(poses):
        if selector.wants(T_world_camera):
            selector.accept(T_world_camera)
            taken.append(index)
    return taken


def test_without_thresholds_every_frame_is_a_keyframe() -> None:
    assert selected(KeyframeConfig(), [pose()] * 4) == [0, 1, 2, 3]


def test_a_frame_needs_rotation_or_translation() -> None:
    poses = [pose(), pose(x=0.4), pose(x=0.6), pose(x=0.6, yaw=0.2), pose(x=0.6, yaw=0.4)]
    assert selected(KeyframeConfig(translation=0.5, rotation=0.3), poses) == [0, 2, 4]


def test_a_threshold_of_zero_does_not_count() -> None:
    turning = [pose(yaw=0.5 * k) for k in range(4)]
    assert selected(KeyframeConfig(translation=0.5), turning) == [0]
    assert selected(KeyframeConfig(rotation=0.4), turning) == [0, 1, 2, 3]


def test_a_norm_that_equals_the_threshold_is_not_larger() -> None:
    assert selected(KeyframeConfig(translation=0.5), [pose(), pose(x=0.5), pose(x=0.75)]) == [0, 2]


def test_a_place_that_is_visited_again_counts_only_against_the_last() -> None:
    there_and_back = [pose(x=x) for x in (0.0, 1.0, 2.0, 1.0, 0.0)]
    assert selected(KeyframeConfig(translation=0.5), there_and_back) == [0, 1, 2, 3, 4]


def test_asking_remembers_nothing() -> None:
    selector = KeyframeSelector(KeyframeConfig(translation=0.5))
    assert selector.wants(pose())
    assert selector.wants(pose())
    selector.accept(pose())
    assert not selector.wants(pose())


@given(
    path=st.lists(st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5)), min_size=1, max_size=12),
    rotation=st.floats(0.05, 2.0),
    translation=st.floats(0.05, 2.0),
)
def test_planar_motion_against_plain_arithmetic(
    path: list[tuple[float, float]], rotation: float, translation: float
) -> None:
    kept: list[int] = []
    for index, (x, yaw) in enumerate(path):
        gaps = [(abs(yaw - path[k][1]), abs(x - path[k][0])) for k in kept[-1:]]
        if any(abs(turn - rotation) < 1e-6 or abs(move - translation) < 1e-6 for turn, move in gaps):
            return  # too close to the threshold for two ways of computing to agree
        if all(turn > rotation or move > translation for turn, move in gaps):
            kept.append(index)
    config = KeyframeConfig(rotation=rotation, translation=translation)
    assert selected(config, [pose(x, yaw) for x, yaw in path]) == kept
