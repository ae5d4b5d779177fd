"""--camera, --undistort and --image-scale: what every reader gets in one place."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets_recordings import CAMERA, Content, write_image, write_seven_scenes, write_tum
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from taichi_mrf.calibration.chessboard import camera_matrix
from taichi_mrf.datasets import ReadOptions, open_dataset
from taichi_mrf.datasets.derived import strided
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera

LENSES = {
    "barrel": (-0.25, 0.08, 0.0, 0.0),
    "tangential": (0.0, 0.0, 0.02, -0.03, 0.0),
    "rational": (0.3, -0.1, 0.001, 0.002, 0.05, 0.4, -0.1, 0.02),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A 7-Scenes recording of 16 x 12 pixels."""
    return write_seven_scenes(tmp_path / "office", Content())


@given(
    st.integers(1, 9), st.integers(9, 60), st.integers(9, 60), st.floats(10, 90), st.floats(-5, 70), st.data()
)
def test_a_kept_pixel_keeps_its_ray(
    stride: int, width: int, height: int, f: float, c: float, data: st.DataObject
) -> None:
    camera = PinholeCamera(width, height, f, 1.1 * f, c, 0.7 * c)
    thin, (row, column) = strided(camera, stride)
    v, u = data.draw(st.integers(0, thin.height - 1)), data.draw(st.integers(0, thin.width - 1))
    rays = camera.rays()[row + stride * v, column + stride * u]
    np.testing.assert_allclose(thin.rays()[v, u], rays, atol=1e-9)
    assert thin.width in (width // stride, width // stride + 1)


@pytest.mark.parametrize("scale", [0.5, 1 / 3, 0.333, 0.25])
def test_image_scale_leaves_pixels_out(folder: Path, scale: float) -> None:
    stride = round(1 / scale)
    whole, thin = open_dataset(folder), open_dataset(folder, image_scale=scale)
    first = (stride - 1) // 2
    assert len(thin) == len(whole)
    for before, after in zip(whole, thin, strict=True):
        np.testing.assert_array_equal(after.depth_m, before.depth_m[first::stride, first::stride])
        np.testing.assert_array_equal(after.color, before.color[first::stride, first::stride])
        np.testing.assert_array_equal(after.T_world_camera, before.T_world_camera)
        assert (after.name, after.stamp, after.camera) == (before.name, before.stamp, thin.camera)
        assert after.depth_m.shape == thin.camera.shape
    assert any(f"one in {stride} rows" in note for note in thin.notes)


@pytest.mark.parametrize("lens", LENSES)
def test_undistorting_picks_the_pixel_that_saw_along_the_ray(tmp_path: Path, lens: str) -> None:
    """Each recorded pixel holds its own number; OpenCV's remapping says which of them a pixel must hold."""
    camera = PinholeCamera(64, 48, 55.0, 57.0, 31.0, 24.5)
    content = Content(1)
    numbers = (1 + np.arange(64 * 48)).reshape(48, 64).astype(np.uint16)
    folder = write_seven_scenes(tmp_path / "office", content)
    write_image(folder / "frame-000000.depth.png", numbers)
    write_image(folder / "frame-000000.color.png", np.zeros((48, 64, 3), np.uint8))
    (folder / "camera.txt").write_text("64 48 55 57 31 24.5")
    frame = open_dataset(folder, undistort=LENSES[lens]).read(0)
    assert frame.camera == camera
    found = np.rint(frame.depth_m * 1000).astype(int)
    K, D = camera_matrix(camera), np.array(LENSES[lens])
    across, down = cv2.initUndistortRectifyMap(K, D, None, K, (64, 48), cv2.CV_32FC1)
    columns, rows = np.rint(across).astype(int), np.rint(down).astype(int)
    inside = (columns >= 0) & (columns < 64) & (rows >= 0) & (rows < 48)
    expected = np.where(inside, 1 + 64 * rows.clip(0, 47) + columns.clip(0, 63), 0)
    undecided = (np.abs(across % 1 - 0.5) < 1e-3) | (np.abs(down % 1 - 0.5) < 1e-3)
    np.testing.assert_array_equal(found[~undecided], expected[~undecided])
    assert (expected != numbers).mean() > 0.2


def seen_along(camera: PinholeCamera, lens: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z, (H, W) each, of the rays that a distorted image's pixels saw along, by fixed-point
    steps."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.rays().reshape(-1, 3)
    for _ in range(50):
        seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera_matrix(camera), np.array(lens))
        error = seen.reshape(-1, 2) - pixels.reshape(-1, 2)
        rays[:, :2] -= error / (camera.fx, camera.fy)
    assert np.abs(error).max() < 1e-9
    return rays[:, 0].reshape(camera.shape), rays[:, 1].reshape(camera.shape)


def test_undistorted_planes_are_planes(tmp_path: Path) -> None:
    """A slanted wall seen through a lens: its points lie on the wall again, edges unmixed."""
    camera = PinholeCamera(160, 120, 120.0, 120.0, 79.5, 59.5)
    lens = (-0.2, 0.05, 0.002, -0.001)
    x, y = seen_along(camera, lens)
    depth_m = 2.0 / (1 + 0.5 * x + 0.2 * y)  # z (1 + 0.5 x + 0.2 y) = 2
    folder = write_seven_scenes(tmp_path / "wall", Content(1))
    write_image(folder / "frame-000000.depth.png", np.rint(depth_m * 10000).astype(np.uint16))
    write_image(folder / "frame-000000.color.png", np.zeros((120, 160, 3), np.uint8))
    (folder / "camera.txt").write_text("160 120 120 120 79.5 59.5")

    def off_the_wall(undistort: tuple[float, ...]) -> float:
        frame = open_dataset(folder, undistort=undistort, depth_scale=10000.0).read(0)
        points = frame.camera.rays() * frame.depth_m[..., None]
        return float(np.abs(points @ [0.5, 0.2, 1.0] - 2.0)[frame.depth_m > 0].max())

    slope = float(np.abs(np.gradient(depth_m)).max())
    assert off_the_wall(lens) < 1.5 * slope  # half a pixel in rows and in columns
    assert off_the_wall((0.0, 0.0, 0.0, 0.0)) > 3 * slope


def test_what_a_lens_model_folds_over_is_no_measurement(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content(1))
    frame = open_dataset(folder, undistort=(-2.0, 0.0, 0.0, 0.0)).read(0)
    slant = np.hypot(*np.moveaxis(CAMERA.rays()[..., :2], -1, 0))
    beyond = slant > np.sqrt(1 / 6.0) + 1e-3  # where r (1 - 2 r^2) turns back
    assert beyond.any()
    assert not frame.depth_m[beyond].any()


def test_scaling_and_undistorting_at_once_is_one_after_the_other(folder: Path) -> None:
    lens = LENSES["barrel"]
    both = open_dataset(folder, undistort=lens, image_scale=0.5).read(0).depth_m
    np.testing.assert_array_equal(both, open_dataset(folder, undistort=lens).read(0).depth_m[::2, ::2])


def test_intrinsics_are_the_callers(folder: Path) -> None:
    dataset = open_dataset(folder, intrinsics=(20.0, 21.0, 8.0, 6.0))
    assert dataset.camera == PinholeCamera(16, 12, 20.0, 21.0, 8.0, 6.0)
    assert dataset.read(0).camera == dataset.camera
    (folder / "camera.txt").unlink()
    told = open_dataset(folder, intrinsics=(20.0, 21.0, 8.0, 6.0), image_scale=0.5)
    assert (told.camera.width, told.camera.fx) == (8, 10.0)
    assert not any("assumed the camera" in note for note in told.notes)


def test_a_rendered_source_is_rendered_with_them(one_backend: str) -> None:
    plain = open_dataset("synthetic:room?frames=1&width=40&height=30&noise=none")
    narrow = open_dataset(
        "synthetic:room?frames=1&width=40&height=30&noise=none", intrinsics=(66.0, 66.0, 19.5, 14.5)
    )
    thin = open_dataset("synthetic:room?frames=1&width=40&height=30&noise=none", image_scale=0.5)
    assert (narrow.read(0).depth_m != plain.read(0).depth_m).mean() > 0.3
    np.testing.assert_array_equal(thin.read(0).depth_m, plain.read(0).depth_m[::2, ::2])


def test_the_time_gap_of_a_format_holds_unless_told_otherwise(tmp_path: Path) -> None:
    folder = write_tum(tmp_path, Content())
    assert len(open_dataset(folder)) == 5
    refused(folder, "within 0.005 s", max_time_gap=0.005)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"image_scale": 0.0}, "image_scale must be 1, 0.5"),
        ({"image_scale": 2.0}, "image_scale must be"),
        ({"image_scale": 0.4}, "image_scale must be"),
        ({"image_scale": float("nan")}, "image_scale must be"),
        ({"image_scale": 0.025}, "leaves no pixel"),
        ({"undistort": (0.1, 0.2)}, "undistort takes k1,k2,p1,p2"),
        ({"undistort": (0.1, 0.2, float("nan"), 0.0)}, "undistort takes"),
        ({"intrinsics": (0.0, 1.0, 1.0, 1.0)}, "both must be positive"),
        ({"intrinsics": (1.0, 1.0, 1.0, 1.0), "camera": CAMERA}, "pass only one of them"),
    ],
)
def test_values_that_make_no_sense(folder: Path, options: dict, said: str) -> None:
    refused(folder, said, **options)


def test_flags_become_options() -> None:
    flags = SourceFlags(1000.0, "500, 501,319.5,239.5", "-0.1,0.02,0,0,0.001", 0.5, 0.1)
    options = ReadOptions(**flags.keywords())
    assert options.intrinsics == (500.0, 501.0, 319.5, 239.5)
    assert options.undistort == (-0.1, 0.02, 0.0, 0.0, 0.001)
    assert (options.depth_scale, options.stride, options.max_time_gap) == (1000.0, 2, 0.1)
    assert ReadOptions(**SourceFlags().keywords()) == ReadOptions()


@pytest.mark.parametrize(
    ("flag", "text"),
    [
        ("camera", "500,500,320"),
        ("camera", "wide"),
        ("camera", ""),
        ("camera", "1,1,inf,1"),
        ("undistort", "1,2,3"),
        ("undistort", "a,b,c,d"),
    ],
)
def test_flags_that_are_no_numbers(flag: str, text: str) -> None:
    with pytest.raises(ConfigError, match=f"--{flag} takes"):
        SourceFlags(**{flag: text})
