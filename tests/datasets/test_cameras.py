"""Cameras of recordings: one for each frame, no pinholes, intrinsics of images of another size, and colours
of a camera of its own."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    INTRINSIC,
    Content,
    K,
    arrays,
    column_by_column,
    text_of,
    write_image,
    write_npz,
    write_numbered,
    write_record3d,
    write_replica,
    write_rows,
    write_scannet,
    write_seven_scenes,
    write_stray,
    write_tum,
)
from inputs_frames import Frames, of_frames
from numpy.typing import NDArray

from taichi_mrf.cli.main import main
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import BuiltIn
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.derived import resampled
from taichi_mrf.datasets.registry import BUILT_IN
from taichi_mrf.errors import DatasetError, FrameError, TaichiMRFError
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.spherical import SphericalCamera

CONTENT = Content(4)
FOCAL = [14.0, 0.0, 21.0, 20.0]
"""Of each frame; zero: not known."""


def matrices(sizes: float = 1.0) -> list[np.ndarray]:
    found = [K.copy() for _ in FOCAL]
    for focal, matrix in zip(FOCAL, found, strict=True):
        matrix[:2] *= focal > 0
        matrix[0, 0] = matrix[1, 1] = focal * sizes
    return found


def open3d(folder: Path) -> Path:
    write_numbered(folder, CONTENT)
    (folder / "camera.txt").unlink()
    entries = [
        {
            "extrinsic": column_by_column(inverse(pose)),
            "intrinsic": INTRINSIC | {"intrinsic_matrix": column_by_column(matrix)},
        }
        for pose, matrix in zip(CONTENT.poses, matrices(), strict=True)
    ]
    trajectory = {"class_name": "PinholeCameraTrajectory", "parameters": entries}
    (folder / "trajectory.json").write_text(json.dumps(trajectory))
    return folder


def npz(folder: Path) -> Path:
    return write_npz(folder.with_suffix(".npz"), arrays(CONTENT) | {"K": np.array(matrices())})


def npz_by_name(folder: Path) -> Path:
    values = arrays(CONTENT) | {"fx": np.array(FOCAL), "fy": np.array(FOCAL)}
    del values["K"]
    center = {name: np.where(np.array(FOCAL) > 0, at, 0) for name, at in (("cx", 7.5), ("cy", 5.5))}
    return write_npz(folder.with_suffix(".npz"), values | center)


def scannet(folder: Path) -> Path:
    write_scannet(folder, CONTENT)
    for i, matrix in enumerate(matrices()):
        (folder / f"intrinsic/{5 * i}.txt").write_text(text_of(matrix))
    return folder


def record3d(folder: Path) -> Path:
    coefficients = [[2 * focal, 2 * focal, 15.5 * (focal > 0), 11.5 * (focal > 0)] for focal in FOCAL]
    return write_record3d(folder, CONTENT, perFrameIntrinsicCoeffs=coefficients)


def stray(folder: Path) -> Path:
    write_stray(folder, CONTENT)
    head, *lines = (folder / "odometry.csv").read_text().splitlines()
    own = (
        f"{line}, {7.5 * focal}, {7.5 * focal}, 960, 720" for line, focal in zip(lines, FOCAL, strict=True)
    )
    (folder / "odometry.csv").write_text("\n".join([f"{head}, fx, fy, cx, cy", *own]))
    return folder


@pytest.mark.parametrize("layout", [open3d, npz, npz_by_name, scannet, record3d, stray])
def test_each_frame_has_its_own_camera(tmp_path: Path, layout: Callable[[Path], Path]) -> None:
    path = layout(tmp_path / "walk")
    dataset = open_dataset(path)
    focal = [frame.camera.fx for frame in dataset]  # type: ignore[attr-defined]
    assert focal == pytest.approx([14.0, 14.0, 21.0, 20.0])
    assert dataset.camera == dataset.read(0).camera
    given = open_dataset(path, intrinsics=(30.0, 30.0, 7.0, 5.0))
    assert {frame.camera.fx for frame in given} == {30.0}  # type: ignore[attr-defined]


def test_a_change_of_resolution_is_a_change_of_camera(tmp_path: Path) -> None:
    folder = scannet(tmp_path / "walk")
    wide = np.kron(CONTENT.depth[2], np.ones((2, 2), np.uint16))
    write_image(folder / "depth/10.png", wide)
    (folder / "intrinsic/10.txt").write_text(text_of(np.diag([2.0, 2, 1]) @ K))
    assert [frame.camera.shape for frame in open_dataset(folder)] == [(12, 16)] * 2 + [(24, 32), (12, 16)]
    (folder / "intrinsic/10.txt").unlink()
    (folder / "intrinsic/0.txt").unlink()
    for number in (5, 15):
        (folder / f"intrinsic/{number}.txt").unlink()
    with pytest.raises(
        FrameError, match=r"^frame 10: .*10.png: the image has 32 x 24 pixels, the camera 16 x 12"
    ):
        list(open_dataset(folder))


def test_files_of_several_cameras(tmp_path: Path) -> None:
    values = arrays(Content(2))
    write_npz(tmp_path / "a.npz", values)
    wide = Content(2, (24, 32))
    write_npz(tmp_path / "b.npz", arrays(wide) | {"K": np.diag([2.0, 2, 1]) @ K})
    assert [frame.camera.shape for frame in open_dataset(tmp_path)] == [(12, 16)] * 2 + [(24, 32)] * 2


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"K": np.zeros((3, 3, 3))}, r"K is \(3, 3, 3\); expected \(3, 3\), or \(4, 3, 3\)"),
        ({"K": np.zeros((4, 3, 3))}, "intrinsics are all zero; --camera"),
        ({"K": np.array([K, K, -K, K])}, "K of frame 2: not the matrix of a pinhole camera"),
    ],
)
def test_wrong_matrices_are_named(tmp_path: Path, change: dict[str, np.ndarray], problem: str) -> None:
    with pytest.raises(DatasetError, match=problem):
        open_dataset(write_npz(tmp_path / "a.npz", arrays(CONTENT) | change))


SCANNER = SphericalCamera(np.linspace(0.5, -0.5, 8), np.linspace(3.0, -3.0, 32))


def scans(camera: Camera) -> Frames:
    """Three scans whose pixels count up."""
    count = np.arange(1.0, 1.0 + camera.width * camera.height, dtype=np.float32).reshape(camera.shape)
    looked = {"sigma_m": 0.01 * count, "no_return": count % 2 == 0}
    frames = [Frame(count, np.eye(4), camera, float(i), "abc"[i], **looked) for i in range(3)]
    return of_frames(frames, "scans")


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> str:
    built_in = BuiltIn("synthetic:scans", lambda query, options: scans(SCANNER))
    monkeypatch.setitem(BUILT_IN, built_in.name, built_in)
    return built_in.name


@pytest.mark.parametrize(
    ("option", "flag"),
    [
        ({"intrinsics": (10.0, 10.0, 4.0, 4.0)}, "--camera"),
        ({"undistort": (0.1, 0.0, 0.0, 0.0)}, "--undistort"),
        ({"image_scale": 0.5}, "--image-scale"),
    ],
)
def test_options_of_pinholes_are_refused(source: str, option: dict[str, object], flag: str) -> None:
    with pytest.raises(DatasetError, match=f"^scans: {flag} needs a pinhole camera, not a SphericalCamera$"):
        open_dataset(source, **option)  # type: ignore[arg-type]


def test_a_recording_has_any_camera_and_info_names_its_kind(
    source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = open_dataset(source)
    assert dataset.camera == dataset.read(0).camera == SCANNER
    assert main(["info", source]) == 0
    assert "SphericalCamera, 32 x 8 rays" in capsys.readouterr().out
    assert main(["info", source, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["camera"] == {"kind": "SphericalCamera", "width": 32, "height": 8}


def test_a_frame_without_more_says_nothing_of_its_pixels() -> None:
    frame = Frame(np.zeros((1, 1), np.float32), np.eye(4), PinholeCamera(1, 1, 1, 1, 0, 0), 0.0, "a")
    assert (frame.sigma_m, frame.noise, frame.no_return) == (None, None, None)


def test_what_belongs_to_pixels_is_picked_with_them() -> None:
    camera = PinholeCamera(8, 6, 9.0, 9.0, 3.5, 2.5)
    thin = resampled(scans(camera), (), 2).read(0)
    full = scans(camera).read(0)
    np.testing.assert_array_equal(thin.sigma_m, full.sigma_m[::2, ::2])
    np.testing.assert_array_equal(thin.no_return, full.no_return[::2, ::2])
    bent = resampled(scans(camera), (2.0, 0.0, 0.0, 0.0), 1).read(0)
    outside = bent.depth_m == 0
    assert outside.any()
    assert not bent.no_return[outside].any()


DOUBLE = np.diag([2.0, 2.0, 1.0]) @ K
"""Of images of 31 x 23 pixels or so."""
TWO = Content(2)


def with_matrix(write: Callable[[Path, Content], Path]) -> Callable[[Path, np.ndarray], Path]:
    def layout(folder: Path, matrix: np.ndarray) -> Path:
        write(folder, TWO)
        (folder / "camera.txt").unlink()
        (folder / "K.txt").write_text(text_of(matrix))
        return folder

    return layout


def numbered_of(folder: Path, content: Content) -> Path:
    write_rows(write_numbered(folder, content) / "poses.txt", content.poses)
    return folder


def scannet_of(folder: Path, matrix: np.ndarray) -> Path:
    write_scannet(folder, TWO)
    (folder / "intrinsic/intrinsic_depth.txt").write_text(text_of(matrix))
    return folder


def npz_of(folder: Path, matrix: np.ndarray) -> Path:
    return write_npz(folder.with_suffix(".npz"), arrays(TWO) | {"K": matrix})


@pytest.mark.parametrize(
    "layout",
    [*map(with_matrix, (write_seven_scenes, write_tum, numbered_of)), scannet_of, npz_of],
    ids=["seven_scenes", "tum", "numbered", "scannet", "npz"],
)
def test_a_matrix_of_another_size(tmp_path: Path, layout: Callable[[Path, np.ndarray], Path]) -> None:
    path = layout(tmp_path / "walk", DOUBLE)
    said = (
        r"images of about 31 x 23 pixels, .*images have 16 x 12: scaled to these they are [\d.,]+; --camera"
    )
    with pytest.raises(TaichiMRFError, match=said) as caught:
        open_dataset(path)
    fits = str(caught.value).split("they are ")[1].split(";")[0].split(",")
    np.testing.assert_allclose(np.array(fits, float), [14.0, 15.0, 7.5, 5.5], rtol=0.05)
    assert open_dataset(path, intrinsics=tuple(map(float, fits))).read(0).camera.shape == (12, 16)  # type: ignore[arg-type]
    with pytest.raises(TaichiMRFError, match="pass the intrinsics of these images: --camera fx,fy,cx,cy"):
        open_dataset(layout(tmp_path / "wide", np.diag([2.0, 3.0, 1.0]) @ K))


def test_a_camera_with_its_size(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", TWO)
    (folder / "camera.txt").write_text("32 24 28 30 15.5 11.5")
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 14,15,7\.5,5\.5"):
        open_dataset(folder).read(0)
    (folder / "camera.txt").unlink()
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 13\.125,13\.125,"):
        open_dataset(folder)
    write_replica(tmp_path / "replica", TWO)
    (tmp_path / "cam_params.json").write_text(
        (tmp_path / "cam_params.json").read_text().replace('"w": 16, "h": 12', '"w": 32, "h": 24')
    )
    with pytest.raises(TaichiMRFError, match=r"scaled to this size it is --camera 7,7\.5,3\.5,2\.5"):
        open_dataset(tmp_path / "replica")


DEPTH = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
COLOR = PinholeCamera(96, 72, 90.0, 90.0, 47.5, 35.5)
BESIDE = np.eye(4)
BESIDE[0, 3] = -0.05
WALL_M, THING_M = 2.0, 1.0
WALL, THING = np.array([20, 40, 200], np.uint8), np.array([220, 30, 10], np.uint8)


def image(camera: PinholeCamera, eye_x: float) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth and colour of a square of 0.4 m in front of a wall, as a camera at x = ``eye_x`` sees them."""
    rays = camera.rays()
    on_thing = (np.abs(rays[..., 0] * THING_M + eye_x) < 0.2) & (np.abs(rays[..., 1] * THING_M) < 0.2)
    depth = np.where(on_thing, THING_M, WALL_M).astype(np.float32)
    return depth, np.where(on_thing[..., None], THING, WALL)


def test_pixels_get_the_colour_of_their_points_and_hidden_ones_none() -> None:
    depth_m, truth = image(DEPTH, 0.0)
    _, color = image(COLOR, 0.05)
    depth_m[10, 10] = 0.0
    found = ColorCamera(COLOR, BESIDE).registered(color, depth_m, DEPTH)
    colored = found.any(axis=2)
    assert not colored[10, 10]
    # Beside the square the colour camera sees the square where the depth camera sees the wall.
    hidden = ~colored & (depth_m == WALL_M)
    assert 0.02 < hidden.mean() < 0.1
    wrong = colored & (np.abs(found.astype(int) - truth).max(axis=2) > 100)
    assert not wrong[depth_m == WALL_M].any()
    assert wrong.mean() < 0.01  # single pixels on the square's edge
    assert colored[depth_m == THING_M].all()


def test_what_the_colour_camera_does_not_see_has_no_colour_and_black_is_one() -> None:
    black = np.zeros((*COLOR.shape, 3), np.uint8)
    depth_m = np.full(DEPTH.shape, WALL_M, np.float32)
    aside = BESIDE.copy()
    aside[0, 3] = -1.0
    found = ColorCamera(COLOR, aside).registered(black, depth_m, DEPTH)
    # Its image ends at u = 0: x of a point = 1 - 47.5 / 90 * 2 m, 59 pixels from the left.
    seen = DEPTH.rays()[0, :, 0] * WALL_M - 1.0 >= -47.5 / 90 * WALL_M
    np.testing.assert_array_equal(found.any(axis=2), np.broadcast_to(seen, DEPTH.shape))
    assert (found[:, seen] == 1).all()
