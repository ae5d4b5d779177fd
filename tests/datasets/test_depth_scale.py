"""The steps per metre of depth images: what neighbouring frames say about them, and what the notes say."""

from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import row_of, stamped_line, write_image

from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
ROOM = np.array([2.5, 2.0, 1.5])
"""Half the sides of an empty room in metres."""


def room_depth_m(T_world_camera: Pose) -> np.ndarray:
    """Axial depth (60, 80) of the room's walls, from inside."""
    directions = CAMERA.rays() @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        to_walls = (np.sign(directions) * ROOM - T_world_camera[:3, 3]) / directions
    return np.nanmin(np.where(directions == 0, np.inf, to_walls), axis=-1)


def walk(frames: int, step_m: float, turn: float = 0.0) -> list[Pose]:
    """It turns by so many radians from one frame to the next."""
    eyes = [np.array([step_m * i - 0.8, 0.3 - step_m * i / 2, 0.1]) for i in range(frames)]
    ahead = [(1 + 0.8j) * np.exp(1j * turn * i) for i in range(frames)]
    return [look_at(e, (e[0] + a.real, e[1] + a.imag, -0.2)) for e, a in zip(eyes, ahead, strict=True)]


def write_room(
    folder: Path, steps_per_metre: float, step_m: float = 0.04, layout: str = "rows", turn: float = 0.0
) -> Path:
    """A walk through the room as numbered images with K.txt."""
    folder.mkdir()
    poses = walk(30, step_m, turn)
    for number, pose in enumerate(poses):
        steps = np.rint(room_depth_m(pose) * steps_per_metre).astype(np.uint16)
        write_image(folder / f"{number:04d}.png", steps)
    (folder / "K.txt").write_text("70 0 39.5\n0 70 29.5\n0 0 1\n")
    lines = [row_of(pose) for pose in poses]
    if layout == "log":
        lines = [
            f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(str, row)) for row in p)
            for i, p in enumerate(poses)
        ]
    (folder / f"poses.{'log' if layout == 'log' else 'txt'}").write_text("\n".join(lines))
    return folder


@pytest.mark.parametrize("layout", ["rows", "log"])
@pytest.mark.parametrize("steps", [1000.0, 5000.0])
def test_an_assumed_scale_is_replaced_by_the_one_that_fits(tmp_path: Path, steps: float, layout: str) -> None:
    dataset = open_dataset(write_room(tmp_path / "mine", steps, layout=layout))
    assert dataset.camera == CAMERA
    np.testing.assert_allclose(dataset.read(7).depth_m, room_depth_m(walk(30, 0.04)[7]), atol=1e-3)
    (note,) = [note for note in dataset.notes if note.startswith("depth:")]
    assert note.startswith(f"depth: {steps:g} steps per metre")
    assert note.endswith("--depth-scale sets another")
    found = steps != (1000.0 if layout == "log" else 5000.0)
    assert ("found by comparing neighbouring frames" in note) == found
    assert ("neighbouring frames differ by 0." in note) == (not found)


def test_a_scale_of_the_format_gives_way_to_the_poses(tmp_path: Path) -> None:
    """As of recorders that write the layout of TUM RGB-D with millimetres."""
    written, folder = open_dataset(write_room(tmp_path / "mine", 1000.0)), tmp_path / "tum"
    (folder / "depth").mkdir(parents=True)
    lines = []
    for i in range(len(written)):
        image = np.rint(1000 * written.read(i).depth_m).astype(np.uint16)
        write_image(folder / f"depth/{i / 10:.6f}.png", image)
        lines.append(stamped_line(i / 10, written.pose(i)))
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    dataset = open_dataset(folder, camera=written.camera)
    assert any("found by comparing neighbouring frames" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.read(3).depth_m, written.read(3).depth_m, atol=1e-3)


def test_a_camera_that_stands_still_does_not_tell(tmp_path: Path) -> None:
    dataset = open_dataset(write_room(tmp_path / "mine", 1000.0, step_m=0.0))
    assert (
        "depth: 5000 steps per metre (assumed as Redwood has it): the median depth is 0." in dataset.notes[0]
    )


def test_a_scale_that_is_given_is_kept_and_doubted(tmp_path: Path) -> None:
    folder = write_room(tmp_path / "mine", 1000.0)
    assert open_dataset(folder, depth_scale=1000.0).notes == []
    dataset = open_dataset(folder, depth_scale=5000.0)
    np.testing.assert_allclose(dataset.read(0).depth_m * 5, room_depth_m(walk(30, 0.04)[0]), atol=2e-3)
    (note,) = dataset.notes
    assert "5000 steps per metre (--depth-scale) do not fit the recorded poses" in note
    assert "at 1000 by 0." in note
    assert open_dataset(folder, depth_scale=5000.0, track=True).notes == []  # its poses do not count


def test_depths_that_cannot_be(tmp_path: Path) -> None:
    folder = write_room(tmp_path / "mine", 1000.0, step_m=0.0)
    (note,) = open_dataset(folder, depth_scale=100_000.0).notes
    assert "make a median depth of 0.0" in note
    assert "not plausible; check --depth-scale" in note


def test_the_scale_is_found_where_the_camera_turns_fast(tmp_path: Path) -> None:
    dataset = open_dataset(write_room(tmp_path / "mine", 1000.0, step_m=0.11, turn=0.6))
    assert any("found by comparing neighbouring frames" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.read(3).depth_m, room_depth_m(walk(4, 0.11, 0.6)[3]), atol=1e-3)
