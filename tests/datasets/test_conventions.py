"""Poses and depths in other conventions come out as those of the same recording in this package's, and an
origin far away is moved, in every format and for poses of a file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from broken_recordings import body, opengl, w_first
from datasets_recordings import CAMERA, FORMATS, Content, stamped_line
from every_format import EVERY
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.conventions import conventions_of
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.trajectories import pose_from_quaternion
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, inverse

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
    folder = FORMATS["tum"][0](tmp_path / "recording", content)
    stamps = open_dataset(folder, camera=CAMERA).stamps()
    lines = [
        stamped_line(s + 0.25, inverse(moved(T, ORIGIN))) for s, T in zip(stamps, content.poses, strict=True)
    ]
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    dataset = open_posed(folder, tmp_path / "poses.txt", poses_are="inverse,late=0.25", camera=CAMERA)
    found = [moved(dataset.pose(i), dataset.origin_m) for i in range(5)]
    assert np.allclose(found, [moved(T, ORIGIN) for T in content.poses], atol=1e-5)
    assert np.array_equal(dataset.read(3).T_world_camera, dataset.pose(3))


def test_late_poses_are_those_stamped_later(tmp_path: Path) -> None:
    """The camera moves 1 m/s along x: half a second late is half a metre."""
    content = Content()
    content.poses = [moved(np.eye(4), [i / 30, 0.0, 0.0]) for i in range(5)]
    folder = FORMATS["tum"][0](tmp_path / "recording", content)
    plain = open_dataset(folder, camera=CAMERA)
    step = plain.stamps()[1] - plain.stamps()[0]
    dataset = open_dataset(folder, camera=CAMERA, poses_are=f"late={0.5 * step}")
    assert len(dataset) == 4
    assert "1 frames dropped" in " ".join(dataset.notes)
    half = plain.pose(1)[0, 3] / 2
    assert np.allclose(
        [dataset.read(i).T_world_camera[0, 3] for i in range(4)], [(2 * i + 1) * half for i in range(4)]
    )
    refused(folder, "no frame has a pose 100 s later", camera=CAMERA, poses_are="late=100")


def test_depth_along_the_ray_becomes_axial(tmp_path: Path) -> None:
    folder = FORMATS["tum"][0](tmp_path / "recording", Content())
    plain = open_dataset(folder, camera=CAMERA).read(2)
    axial = open_dataset(folder, camera=CAMERA, depth_is="range").read(2)
    u, v = np.meshgrid(np.arange(16), np.arange(12))
    slant = np.sqrt(1 + ((u - CAMERA.cx) / CAMERA.fx) ** 2 + ((v - CAMERA.cy) / CAMERA.fy) ** 2)
    assert np.allclose(axial.depth_m * slant, plain.depth_m, rtol=1e-6)


@pytest.mark.parametrize(
    ("flags", "text"),
    [
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
    found = conventions_of("ros,late=0.5,inverse,wxyz", (1, 2, 3, 0, 0, 0, 1), "range")
    assert tuple(found.flags()) == given
