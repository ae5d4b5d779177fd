"""The synthetic corridor and ring, walkable and closed, and data/tiny_room, the room that it claims to be."""

import itertools
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.config.schema import EvaluationConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.datasets.synthetic.corridor import (
    CORRIDOR_IN_WORLD,
    HALF_WIDTH,
    OVERLAP_M,
    Room,
    SmoothPath,
    corridor_length,
    corridor_scene,
    waypoints,
)
from taichi_mrf.datasets.synthetic.room_furniture import HEIGHT, LENGTH, WALL, WIDTH, room_scene
from taichi_mrf.geometry.poses import as_pose, tangent_norms
from taichi_mrf.mapping.selection import is_held_out

SMALL = "synthetic:corridor?rooms=3&frames=40&width=80&height=60"


def test_by_default_it_gives_a_map_more_than_500_keyframes() -> None:
    corridor = open_dataset("synthetic:corridor")
    every = EvaluationConfig().hold_out
    kept = [number for number in range(1, len(corridor) + 1) if not is_held_out(number, every)]
    assert len(kept) >= 500
    assert corridor.camera.shape == (240, 320)
    assert format_name("synthetic:corridor?rooms=3") == "synthetic:corridor"


@pytest.mark.parametrize("rooms", [1, 4, 12])
def test_the_camera_keeps_clear_and_visits_every_room(rooms: int) -> None:
    corridor = open_dataset(f"synthetic:corridor?rooms={rooms}&frames={60 * rooms}")
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
    path = waypoints(12)
    assert path[0, 0] < 1 < corridor_length(12) - 1 < path[-1, 0]


@pytest.mark.parametrize("rooms", [1, 2, 3])
def test_it_is_closed(backend: str, rooms: int) -> None:
    corridor = open_dataset(f"synthetic:corridor?rooms={rooms}&frames=24&width=80&height=60&noise=none")
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
    corridor = open_dataset(SMALL)
    for index in range(0, 40, 5):
        np.testing.assert_array_equal(
            corridor.read(index).depth_m, open_dataset(SMALL, color=False).read(index).depth_m
        )


RING = "synthetic:ring?frames=60&width=80&height=60&noise=none"


@pytest.mark.parametrize("length", [24, 60])
def test_the_camera_keeps_clear_and_comes_back(length: int) -> None:
    ring = open_dataset(f"{RING}&length={length}")
    poses = [ring.camera_path.pose_at(metres) for metres in np.arange(0.0, ring.camera_path.length_m, 0.1)]
    assert ring.signed_distance([T[:3, 3] for T in poses]).min() > 0.3
    assert 0.9 * (length + OVERLAP_M) < ring.camera_path.length_m < length + OVERLAP_M
    # The last metres are the first ones once more, in the same direction.
    again = [tangent_norms(T, ring.camera_path.pose_at(OVERLAP_M - 0.5)) for T in poses[-10:]]
    assert min(shifted for _, shifted in again) < 0.2
    assert min(turned for turned, _ in again) < 0.6
    assert np.ptp([T[:3, 3] for T in poses], axis=0)[:2].min() > length / 6 - 1
    turns, steps = np.transpose([tangent_norms(a, b) for a, b in itertools.pairwise(poses)])
    assert steps.max() < 0.12
    assert np.degrees(turns.max()) < 15
    for T in poses[::40]:
        np.testing.assert_allclose(as_pose(T), T, atol=1e-12)


def test_a_way_goes_where_its_corners_are_and_rounds_them() -> None:
    path = SmoothPath([(0.0, 0.0), (10.0, 0.0), (10.0, 8.0)], rounding_m=2.0, floor_z=-1.0)
    begin, end = path.pose_at(0.0), path.pose_at(path.length_m)
    np.testing.assert_allclose(begin[:2, 3], [0, 0], atol=0.05)
    np.testing.assert_allclose(end[:2, 3], [10, 8], atol=0.05)
    assert 17 < path.length_m < 18
    # In the middle of the first side it walks along x, upright, 1.5 m over the floor.
    middle = path.pose_at(5.0)
    assert middle[2, 3] == pytest.approx(0.5, abs=0.04)
    assert middle[0, 2] > 0.9
    assert middle[2, 1] < -0.95
    corner = min(np.linalg.norm(path.pose_at(s)[:2, 3] - (10, 0)) for s in np.arange(9, 11, 0.05))
    assert 0.05 < corner < 0.5


def test_it_is_closed_and_bare_walls_are_seen_through_nothing(backend: str) -> None:
    furnished, bare = open_dataset(RING), open_dataset(f"{RING}&walls=bare")
    assert len(bare.scene.solids) == 7 < len(furnished.scene.solids)
    for index in range(0, 60, 12):
        T, seen = bare.pose(index), bare.clean_depth(index)
        assert (furnished.clean_depth(index) <= seen + 1e-4).all()
        assert (furnished.clean_depth(index) < seen - 0.05).any()
        points = (bare.camera.rays() * seen[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        assert (seen > 0).all()
        assert np.abs(bare.signed_distance(points)).max() < 2e-3


@pytest.fixture(scope="module")
def remade(one_backend: str, repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sequence as the script makes it here."""
    script, folder = (
        repository / "data" / "make_tiny_sequence.py",
        tmp_path_factory.mktemp("data") / "tiny_room",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(script), str(folder)])
        runpy.run_path(str(script), run_name="__main__")
    return folder


def test_it_is_small_and_a_dozen(repository: Path) -> None:
    folder = repository / "data" / "tiny_room"
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 1_000_000
    dataset = open_dataset(folder)
    assert len(dataset) == 12
    assert dataset.dropped == 0
    assert dataset.notes == []
    assert dataset.camera.shape == (240, 320)


def test_its_points_lie_on_the_rooms_surfaces(repository: Path) -> None:
    scene = room_scene()
    for frame in open_dataset(repository / "data" / "tiny_room"):
        assert frame.color is not None
        seen = frame.depth_m > 0
        assert seen.mean() > 0.8
        z = frame.depth_m[seen].astype(np.float64)
        points = frame.camera.rays()[seen] * z[:, None] @ frame.T_world_camera[:3, :3].T
        distance = np.abs(scene.signed_distance(points + frame.T_world_camera[:3, 3]))
        sigma = np.hypot(0.001504 - 0.00152 * z + 0.0019 * z**2, 0.00285 * z**2 / np.sqrt(12))
        assert (distance < 3 * sigma + 1e-4).mean() > 0.99  # 3 sigma hold 99.7% of a normal distribution


def test_the_script_makes_it_again(repository: Path, remade: Path) -> None:
    kept, made = open_dataset(repository / "data" / "tiny_room"), open_dataset(remade)
    assert kept.frame_names == made.frame_names
    assert kept.camera == made.camera
    for a, b in zip(kept, made, strict=True):
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=1e-8)
        # Another processor may round a ray to the other side of an edge or of a step of disparity.
        assert (np.abs(a.depth_m - b.depth_m) > 1e-3).mean() < 1e-3
