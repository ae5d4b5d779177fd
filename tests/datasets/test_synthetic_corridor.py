"""The synthetic corridor: long enough, walkable, closed, and the same each time."""

import itertools

import numpy as np
import pytest

from taichi_mrf.config.schema import EvaluationConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.datasets.synthetic.corridor import (
    CORRIDOR_IN_WORLD,
    HALF_WIDTH,
    Room,
    SyntheticCorridor,
    corridor_length,
    corridor_scene,
    waypoints,
)
from taichi_mrf.datasets.synthetic.room_furniture import HEIGHT, LENGTH, WALL, WIDTH
from taichi_mrf.geometry.poses import as_pose, tangent_norms
from taichi_mrf.mapping.selection import is_held_out

SMALL = "synthetic:corridor?rooms=3&frames=40&width=80&height=60"


def opened(source: str) -> SyntheticCorridor:
    dataset = open_dataset(source)
    assert isinstance(dataset, SyntheticCorridor)
    return dataset


def test_by_default_it_gives_a_map_more_than_500_keyframes() -> None:
    corridor = opened("synthetic:corridor")
    every = EvaluationConfig().hold_out
    kept = [number for number in range(1, len(corridor) + 1) if not is_held_out(number, every)]
    assert len(kept) >= 500
    assert corridor.camera.shape == (240, 320)
    assert format_name("synthetic:corridor?rooms=3") == "synthetic:corridor"


@pytest.mark.parametrize("rooms", [1, 4, 12])
def test_the_camera_keeps_clear_and_visits_every_room(rooms: int) -> None:
    corridor = opened(f"synthetic:corridor?rooms={rooms}&frames={60 * rooms}")
    poses = [corridor.pose(i) for i in range(len(corridor))]
    eyes = np.array([T[:3, 3] for T in poses])
    assert corridor.signed_distance(eyes).min() > 0.35  # a doorway is 0.92 m wide
    plan = eyes - CORRIDOR_IN_WORLD
    for number in range(rooms):
        middle = Room(number).to_plan(0.0, 0.0)
        inside = (np.abs(plan[:, :2] - middle) < (LENGTH / 2, WIDTH / 2)).all(axis=1)
        assert inside.sum() > 20
    assert np.ptp(plan[:, 0]) > 0.6 * corridor_length(rooms)
    steps = np.array([tangent_norms(a, b) for a, b in itertools.pairwise(poses)])
    assert steps.max(axis=0)[0] < 1.0
    assert steps.max(axis=0)[1] < 0.5
    for T in poses[::7]:
        np.testing.assert_allclose(as_pose(T), T, atol=1e-12)


def test_rooms_differ_and_the_way_ends_at_the_other_end() -> None:
    scene = corridor_scene(12)
    kinds = [
        tuple(
            sorted(
                (solid.kind, *np.round(solid.half_size, 3))
                for solid in scene.solids
                if np.hypot(*(np.array(solid.center[:2]) - CORRIDOR_IN_WORLD[:2] - Room(n).to_plan(0, 0))) < 2
            )
        )
        for n in range(12)
    ]
    assert len(set(kinds)) >= 5
    way = waypoints(12)
    assert way[0, 0] < 1 < corridor_length(12) - 1 < way[-1, 0]


@pytest.mark.parametrize("rooms", [1, 2, 3])
def test_it_is_closed(backend: str, rooms: int) -> None:
    corridor = opened(f"synthetic:corridor?rooms={rooms}&frames=24&width=80&height=60&noise=none")
    reach = np.array([corridor_length(rooms) / 2, HALF_WIDTH + WALL + WIDTH, HEIGHT / 2])
    middle = np.array([corridor_length(rooms) / 2, 0, HEIGHT / 2]) + CORRIDOR_IN_WORLD
    for index in range(len(corridor)):
        T, depth = corridor.pose(index), corridor.clean_depth(index).astype(np.float64).reshape(-1, 1)
        assert (depth > 0).all()
        points = T[:3, 3] + depth * (corridor.camera.rays().reshape(-1, 3) @ T[:3, :3].T)
        assert (np.abs(points - middle) < reach + 0.01).all()
        assert np.abs(corridor.signed_distance(points)).max() < 2e-4


def test_what_is_left_out_of_a_depth_picture_is_not_in_it(backend: str) -> None:
    """Solids beside the picture are not rendered; with a colour picture all of them are."""
    corridor = opened(SMALL)
    for index in range(0, 40, 5):
        np.testing.assert_array_equal(
            corridor.read(index).depth_m, open_dataset(SMALL, color=False).read(index).depth_m
        )
