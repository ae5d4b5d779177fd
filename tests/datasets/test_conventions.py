"""Poses and depths in other conventions come out as those of the same recording in this package's, an origin
far away is moved, and frames agree on the steps per metre."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from broken_recordings import body, opengl, w_first
from datasets_recordings import (
    CAMERA,
    Content,
    write_image,
    write_log,
    write_rows,
    write_stamped,
    write_tum,
)
from every_format import EVERY
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.conventions import TURNS, conventions_of
from taichi_mrf.datasets.derived import strided
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.datasets.turned import T_sensor_stored, put_back, sensor_camera, stored_camera
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, inverse, look_at
from taichi_mrf.sensor.camera import PinholeCamera

ORIGIN = np.array([412_345.25, 5_412_345.75, 312.5])
MOUNTING = (0.1, -0.2, 0.3, 0.5, -0.5, 0.5, -0.5)


def on_mounting(T: Pose) -> Pose:
    return T @ inverse(pose_from_quaternion(np.array(MOUNTING)))


def in_steps(T: Pose, per_metre: float) -> Pose:
    return moved(T, (per_metre - 1) * T[:3, 3])


WRITTEN: dict[str, tuple[Callable[[Pose], Pose], dict]] = {
    "inverse": (inverse, {"poses_are": "inverse"}),
    "opengl": (opengl, {"poses_are": "opengl"}),
    "ros": (body, {"poses_are": "ros"}),
    "w first": (w_first, {"poses_are": "wxyz"}),
    "inverse, opengl": (lambda T: inverse(opengl(T)), {"poses_are": "opengl,inverse"}),
    "w first, inverse": (lambda T: w_first(inverse(T)), {"poses_are": "wxyz,inverse"}),
    "millimetres": (lambda T: in_steps(T, 1000), {"poses_are": "mm"}),
    "inverse, centimetres": (lambda T: in_steps(inverse(T), 100), {"poses_are": "cm,inverse"}),
    "mounting": (on_mounting, {"mounting": MOUNTING}),
}


def moved(T: Pose, by_m: np.ndarray) -> Pose:
    out = T.copy()
    out[:3, 3] += by_m
    return out


@pytest.mark.parametrize("kind", WRITTEN)
@pytest.mark.parametrize("name", EVERY)
def test_poses_come_out_as_of_the_camera(name: str, kind: str, tmp_path: Path) -> None:
    content, (written, flags) = Content(), WRITTEN[kind]
    expected = [T.copy() for T in content.poses]
    content.poses = [written(T) for T in content.poses]
    dataset = open_dataset(EVERY[name](tmp_path / "recording", content), **flags)
    assert np.allclose([dataset.pose(i) for i in range(5)], expected, atol=1e-6)
    assert np.array_equal(
        [dataset.read(i).T_world_camera for i in range(5)], [dataset.pose(i) for i in range(5)]
    )
    assert any(note.startswith("conventions: --") for note in dataset.notes)


@pytest.mark.parametrize("name", EVERY)
def test_an_origin_far_away_is_moved(name: str, tmp_path: Path) -> None:
    content = Content()
    expected = [T.copy() for T in content.poses]
    content.poses = [moved(T, ORIGIN) for T in content.poses]
    dataset = open_dataset(EVERY[name](tmp_path / "recording", content))
    assert np.abs(dataset.read(0).T_world_camera[:3, 3]).max() < 1000
    for index, T in enumerate(expected):
        assert np.allclose(moved(dataset.pose(index), dataset.origin_m), moved(T, ORIGIN), atol=1e-6)
    assert "the origin of the world is moved to 412000 5412000 0" in dataset.notes


def test_poses_of_a_file_have_conventions_and_an_origin_too(tmp_path: Path) -> None:
    content = Content()
    folder = write_tum(tmp_path / "recording", content)
    stamps = open_dataset(folder, camera=CAMERA).stamps()
    inverses = [inverse(moved(T, ORIGIN)) for T in content.poses]
    poses = write_stamped(tmp_path / "poses.txt", np.array(stamps) + 0.25, inverses)
    dataset = open_posed(folder, poses, poses_are="inverse,late=0.25", camera=CAMERA)
    found = [moved(dataset.pose(i), dataset.origin_m) for i in range(5)]
    assert np.allclose(found, [moved(T, ORIGIN) for T in content.poses], atol=1e-5)
    assert np.array_equal(dataset.read(3).T_world_camera, dataset.pose(3))


def test_late_poses_are_those_stamped_later(tmp_path: Path) -> None:
    """The camera moves 1 m/s along x: half a second late is half a metre."""
    content = Content()
    content.poses = [moved(np.eye(4), [i / 30, 0.0, 0.0]) for i in range(5)]
    folder = write_tum(tmp_path / "recording", content)
    plain = open_dataset(folder, camera=CAMERA)
    step = plain.stamps()[1] - plain.stamps()[0]
    dataset = open_dataset(folder, camera=CAMERA, poses_are=f"late={0.5 * step}")
    assert len(dataset) == 4
    assert "1 frames dropped" in " ".join(dataset.notes)
    posed = np.loadtxt(folder / "groundtruth.txt", comments="#")
    expected = np.interp(np.array(plain.stamps()[:4]) + 0.5 * step, posed[:, 0], posed[:, 1])
    assert np.allclose([dataset.read(i).T_world_camera[0, 3] for i in range(4)], expected)
    refused(folder, "no frame has a pose 100 s later", camera=CAMERA, poses_are="late=100")


def test_late_poses_are_interpolated_in_their_own_times(tmp_path: Path) -> None:
    """Poses at ten times the rate of the images, on a path that bends between two images."""
    content = Content()
    folder = write_tum(tmp_path / "recording", content)
    stamps = np.array(open_dataset(folder, camera=CAMERA).stamps())
    step = stamps[1] - stamps[0]

    def place(t: float) -> np.ndarray:
        return moved(np.eye(4), [np.sin(6 * (t - stamps[0]) / step), 0.0, 0.0])

    dense = np.arange(stamps[0] - step, stamps[-1] + 2 * step, step / 10)
    write_stamped(folder / "groundtruth.txt", dense, [place(t) for t in dense])
    plain = open_dataset(folder, camera=CAMERA)
    assert len(plain) == len(stamps)
    dataset = open_dataset(folder, camera=CAMERA, poses_are=f"late={0.45 * step}")
    assert len(dataset) == len(stamps)
    assert not any("only the poses of frames" in note for note in dataset.notes)
    found = [dataset.read(i).T_world_camera[0, 3] for i in range(len(dataset))]
    expected = [place(t + 0.45 * step)[0, 3] for t in stamps]
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_where_a_recording_has_pairs_alone_late_says_so(tmp_path: Path) -> None:
    content = Content()
    folder = EVERY["Record3D"](tmp_path / "a", content)
    plain = open_dataset(folder)
    gap = float(plain.stamps()[1] - plain.stamps()[0])
    dataset = open_dataset(folder, poses_are=f"late={gap / 2}")
    assert any("has only the poses of frames" in note for note in dataset.notes)


def test_depth_along_the_ray_becomes_axial(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "recording", Content())
    plain = open_dataset(folder, camera=CAMERA).read(2)
    axial = open_dataset(folder, camera=CAMERA, depth_is="range").read(2)
    u, v = np.meshgrid(np.arange(16), np.arange(12))
    slant = np.sqrt(1 + ((u - CAMERA.cx) / CAMERA.fx) ** 2 + ((v - CAMERA.cy) / CAMERA.fy) ** 2)
    assert np.allclose(axial.depth_m * slant, plain.depth_m, rtol=1e-6)


@pytest.mark.parametrize("intrinsics", ["sensor", "stored"])
@pytest.mark.parametrize("turned", TURNS)
def test_turned_images_are_put_back(turned: str, intrinsics: str, tmp_path: Path) -> None:
    """Also thinned out; intrinsics may be those of the images as they are stored."""
    left, mirrored = TURNS[turned]
    frames = list(open_dataset(write_room(tmp_path / "plain", 1000.0)))
    folder = tmp_path / "turned"
    for number, frame in enumerate(frames):
        steps = np.rint(1000 * frame.depth_m).astype(np.uint16)
        stored = np.rot90(steps[:, ::-1] if mirrored else steps, left)
        write_image(folder / f"{number:04d}.png", np.ascontiguousarray(stored))
    cx, cy = (WIDE.cy, WIDE.cx) if left % 2 and intrinsics == "stored" else (WIDE.cx, WIDE.cy)
    (folder / "K.txt").write_text(f"70 0 {cx}\n0 70 {cy}\n0 0 1\n")
    write_rows(folder / "poses.txt", [frame.T_world_camera for frame in frames])
    dataset = open_dataset(folder, image_is=turned)
    assert dataset.camera == WIDE
    assert any(note.startswith("depth: 1000 steps per metre, found") for note in dataset.notes)
    assert f"conventions: --image-is {turned}" in dataset.notes
    read, thin = dataset.read(7), open_dataset(folder, image_is=turned, image_scale=0.5).read(7)
    np.testing.assert_array_equal(read.depth_m, frames[7].depth_m)
    assert (read.camera, thin.camera) == (WIDE, strided(WIDE, 2)[0])
    np.testing.assert_array_equal(thin.depth_m, frames[7].depth_m[::2, ::2])


@pytest.mark.parametrize("turned", TURNS)
def test_the_camera_of_a_stored_image_sees_what_it_shows(turned: str) -> None:
    """A point of the sensor's frame, in that of the stored image, is seen where its pixel has gone."""
    left, mirrored = TURNS[turned]
    sensor = PinholeCamera(80, 60, 70.0, 72.0, 41.0, 28.0)
    marked = np.zeros(sensor.shape)
    marked[11, 23] = 1
    stored = np.rot90(marked[:, ::-1] if mirrored else marked, left)
    camera = stored_camera(replace(sensor, width=stored.shape[1], height=stored.shape[0]), turned)
    point = T_sensor_stored(turned)[:3, :3].T @ (2.0 * sensor.directions(23, 11))
    u, v, depth_m = camera.project(point[None])[0]
    assert stored[round(v), round(u)] == 1
    np.testing.assert_allclose([u, v, depth_m], [round(u), round(v), 2.0])
    assert sensor_camera(camera, turned) == sensor or not left % 2
    np.testing.assert_array_equal(put_back(stored, turned), marked)


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ({"image_is": "turned-lft"}, "--image-is: no such word 'turned-lft'; did you mean 'turned-left'"),
        ({"image_is": "turned-left,upside-down"}, "turned-left and upside-down are both turns"),
        ({"poses_are": "invers"}, "no such word 'invers'; did you mean 'inverse'"),
        ({"poses_are": "opengl,ros"}, "opengl and ros are both axes"),
        ({"poses_are": "mm,cm"}, "mm and cm are both units"),
        ({"poses_are": "late=soon"}, "a number of seconds, not 'soon'"),
        ({"mounting": "1,2,3"}, "--mounting takes x,y,z,qx,qy,qz,qw, not '1,2,3'"),
        ({"mounting": "1,2,3,0,0,0,0"}, "its quaternion is zero"),
    ],
)
def test_wrong_words_are_named(flags: dict[str, str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        SourceFlags(**flags)


def test_flags_say_their_conventions() -> None:
    given = ("--poses-are wxyz,inverse,ros,late=0.5", "--mounting 1,2,3,0,0,0,1", "--depth-is range")
    found = conventions_of(
        "ros,late=0.5,inverse,wxyz", (1, 2, 3, 0, 0, 0, 1), "range", "mirrored,turned-left"
    )
    assert tuple(found.flags()) == (*given, "--image-is turned-left,mirrored")
    assert conventions_of("blender,arkit", None, "axial").axes == "opengl"


WIDE = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
ROOM = np.array([2.5, 2.0, 1.5])
"""Half the sides of an empty room in metres."""


def room_depth_m(T_world_camera: Pose) -> np.ndarray:
    """Axial depth (60, 80) of the room's walls, from inside."""
    directions = WIDE.rays() @ T_world_camera[:3, :3].T
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
    if layout == "log":
        write_log(folder / "poses.log", poses)
    else:
        write_rows(folder / "poses.txt", poses)
    return folder


@pytest.mark.parametrize("layout", ["rows", "log"])
@pytest.mark.parametrize("steps", [1000.0, 5000.0, 4000.0, 6553.5])
def test_an_assumed_scale_is_replaced_by_the_one_that_fits(tmp_path: Path, steps: float, layout: str) -> None:
    dataset = open_dataset(write_room(tmp_path / "mine", steps, layout=layout))
    assert dataset.camera == WIDE
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
    stamps = [i / 10 for i in range(len(written))]
    for stamp, frame in zip(stamps, written, strict=True):
        image = np.rint(1000 * frame.depth_m).astype(np.uint16)
        write_image(folder / f"depth/{stamp:.6f}.png", image)
    write_stamped(folder / "groundtruth.txt", stamps, [frame.T_world_camera for frame in written])
    dataset = open_dataset(folder, camera=written.camera)
    assert any("found by comparing neighbouring frames" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.read(3).depth_m, written.read(3).depth_m, atol=1e-3)


def test_a_camera_that_stands_still_does_not_tell(tmp_path: Path) -> None:
    folder = write_room(tmp_path / "mine", 1000.0, step_m=0.0)
    said = "depth: 5000 steps per metre (assumed as Redwood has it): the median depth is 0."
    assert said in open_dataset(folder).notes[0]
    (note,) = open_dataset(folder, depth_scale=100_000.0).notes
    assert "make a median depth of 0.0" in note
    assert "not plausible; check --depth-scale" in note


def test_a_scale_that_is_given_is_kept_and_doubted(tmp_path: Path) -> None:
    folder = write_room(tmp_path / "mine", 1000.0)
    assert open_dataset(folder, depth_scale=1000.0).notes == []
    dataset = open_dataset(folder, depth_scale=5000.0)
    np.testing.assert_allclose(dataset.read(0).depth_m * 5, room_depth_m(walk(30, 0.04)[0]), atol=2e-3)
    (note,) = dataset.notes
    assert "5000 steps per metre (--depth-scale) do not fit the recorded poses" in note
    assert "at 1000 by 0." in note
    assert open_dataset(folder, depth_scale=5000.0, track=True).notes == []  # its poses do not count


def test_the_scale_is_found_where_the_camera_turns_fast(tmp_path: Path) -> None:
    dataset = open_dataset(write_room(tmp_path / "mine", 1000.0, step_m=0.11, turn=0.6))
    assert any("found by comparing neighbouring frames" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.read(3).depth_m, room_depth_m(walk(4, 0.11, 0.6)[3]), atol=1e-3)
