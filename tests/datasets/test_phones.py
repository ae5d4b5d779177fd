"""Recordings of phones, by Record3D and Stray Scanner: depth, poses, cameras, colours, and confidence as a
sigma for each pixel."""

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import CAMERA, Content, write_image, write_record3d, write_stray
from refusals import bad_frame, refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.formats.record3d import held_bytes, unpacked
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera

CONTENT = Content(3)
FLOATS = np.linspace(0.3, 5.0, 192, dtype=np.float32)


def packer() -> Callable[[bytes], bytes]:
    compress: Callable[[bytes], bytes] = pytest.importorskip("lzfse", reason="packing needs lzfse").compress
    return compress


@pytest.fixture(params=["walk.r3d", "walk"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_record3d(tmp_path / request.param, CONTENT)


@pytest.mark.parametrize("name", ["walk.r3d", "walk"])
@pytest.mark.parametrize("is_packed", [False, True])
def test_what_was_recorded_comes_back(tmp_path: Path, name: str, is_packed: bool) -> None:
    dataset = open_dataset(write_record3d(tmp_path / name, CONTENT, packer() if is_packed else bytes))
    assert (len(dataset), dataset.dropped, dataset.name) == (3, 0, "walk")
    assert dataset.camera == CAMERA
    for i, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.depth_m, CONTENT.depth[i] / 1000, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, CONTENT.poses[i], atol=1e-9)
        assert frame.stamp == pytest.approx(0.1 * i)
        measured = frame.depth_m > 0
        # The middle of a depth pixel is the corner that its four colour pixels share.
        np.testing.assert_allclose(frame.color[measured], np.maximum(CONTENT.color[i], 0)[measured], atol=1)
        assert not frame.color[~measured].any()


def test_confidence_is_a_sigma(path: Path) -> None:
    dataset = open_dataset(path)
    sigma_m = dataset.read(0).sigma_m
    np.testing.assert_allclose(sigma_m[:, :3], np.tile([np.inf, 0.02, 0.01], (12, 1)), rtol=1e-6)
    assert with_recorded_noise(Config(), dataset).sensor == SensorConfig(sigma=(0.01,))


def test_a_recording_without_confidence_states_no_sigma(tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "walk", CONTENT)
    for i in range(3):
        (folder / f"rgbd/{i}.conf").unlink()
    dataset = open_dataset(folder)
    assert dataset.read(0).sigma_m is None
    assert dataset.stated.sigma is None


def test_each_frame_may_have_its_own_camera(tmp_path: Path) -> None:
    intrinsics = [[28.0 + i, 30.0 + i, 15.5, 11.5] for i in range(3)]
    path = write_record3d(tmp_path / "walk.r3d", CONTENT, perFrameIntrinsicCoeffs=intrinsics)
    dataset = open_dataset(path)
    for i, frame in enumerate(dataset):
        assert frame.camera == PinholeCamera(16, 12, 14 + i / 2, 15 + i / 2, 7.5, 5.5)
    small = open_dataset(path, image_scale=0.5)
    assert small.read(2).camera == PinholeCamera(8, 6, 7.5, 8.0, 3.75, 2.75)
    np.testing.assert_array_equal(small.read(2).depth_m, dataset.read(2).depth_m[::2, ::2])
    given = open_dataset(path, intrinsics=(20.0, 21.0, 7.0, 5.0))
    assert given.read(2).camera == given.camera == PinholeCamera(16, 12, 20.0, 21.0, 7.0, 5.0)
    bent = open_dataset(path, undistort=(0.1, 0.0, 0.0, 0.0))
    bent.read(0)
    bad_frame(bent, 1, "has intrinsics of its own; --undistort needs --camera")


def test_stamps_and_sizes_that_may_be_missing(tmp_path: Path) -> None:
    path = write_record3d(
        tmp_path / "walk.r3d", CONTENT, frameTimestamps=[5.0, 5.2, 5.3], dw=None, dh=None, fps=None
    )
    dataset = open_dataset(path)
    assert dataset.camera == CAMERA
    assert list(dataset.stamps()) == [5.0, 5.2, 5.3]
    assumed = open_dataset(write_record3d(tmp_path / "b.r3d", CONTENT, fps=None))
    assert assumed.read(1).stamp == pytest.approx(1 / 30)
    assert any("assumed 30 frames a second" in note for note in assumed.notes)


def test_images_without_a_pose_are_dropped(tmp_path: Path) -> None:
    path = write_record3d(tmp_path / "walk.r3d", CONTENT, poses=[[0.0, 0, 0, 1, 1, 2, 3]])
    dataset = open_dataset(path)
    assert (dataset.frame_names, dataset.dropped) == (["000000"], 2)


@pytest.mark.parametrize("poses", [None, [], [[0, 0, 0, 1, 0, 0, 0]] * 3])
def test_a_recording_of_the_front_camera_has_to_be_tracked(tmp_path: Path, poses: object) -> None:
    path = write_record3d(tmp_path / "walk.r3d", CONTENT, poses=poses)
    said = f"{path}: metadata: contains no poses, as recordings of the front camera do not; --track-poses"
    refused(path, said)
    dataset = open_dataset(path, track=True)
    assert dataset.tracked
    assert len(dataset) == 3
    np.testing.assert_array_equal(dataset.read(0).T_world_camera[:3, 3], 0)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"w": 0}, "w is 0, not a number of pixels"),
        ({"dh": 1e9}, "dh is 1000000000, not a number"),
        ({"dw": 1 << 20, "dh": 1 << 20}, "at most 16,777,216 are read"),
        ({"dw": None}, "dw is None"),
        ({"dw": 12, "dh": 12}, "depth of 12 x 12 pixels has other proportions than colour of 32 x 24"),
        ({"K": [1, 2, 3]}, "K is not a list of 9 numbers"),
        ({"K": [1, 0, 0, "one", 1, 0, 0, 0, 1]}, "K is not a list of 9 numbers"),
        ({"K": [-28, 0, 0, 0, 30, 0, 15, 11, 1]}, " both must be positive"),
        ({"poses": [[0, 0, 1], [1, 2]]}, "poses is not a list of 7 numbers for each frame"),
        ({"poses": 5}, "poses is not a list of 7"),
        ({"frameTimestamps": [1.0]}, "frameTimestamps must be a number for each frame"),
        ({"frameTimestamps": [0.0, float("nan"), 1.0]}, "frameTimestamps must be a number"),
        ({"perFrameIntrinsicCoeffs": [[1, 1, 0, 0]]}, "has 1 entries, none for frame 2"),
        ({"perFrameIntrinsicCoeffs": [[1, 0, 0, 0]] * 3}, "must be positive"),
    ],
)
def test_metadata_that_cannot_be_used_are_named(
    tmp_path: Path, changes: dict[str, object], problem: str
) -> None:
    path = write_record3d(tmp_path / "walk.r3d", CONTENT, **changes)
    refused(path, "walk.r3d: metadata: ", problem)


@pytest.mark.parametrize("text", [b"", b"[1]", b"{", b"[" * 100_000, b"\xff"])
def test_metadata_that_are_no_json_are_named(tmp_path: Path, text: bytes) -> None:
    folder = write_record3d(tmp_path / "walk", CONTENT)
    (folder / "metadata").write_bytes(text)
    refused(folder, str(folder / "metadata"))


@pytest.mark.parametrize(
    ("file", "data", "problem"),
    [
        ("depth", bytes(100), "holds 100 bytes, expected 768"),
        ("depth", b"", "holds 0 bytes, expected 768"),
        ("depth", bytes(1 << 20), "has 1,048,576 bytes; at most 5,632 are expected"),
        (
            "depth",
            b"bvx2" + struct.pack("<IQQI", 1 << 30, 0, 0, 32) + bytes(4) + b"bvx$",
            "holds 1,073,741,824 bytes",
        ),
        (
            "depth",
            b"bvx2" + struct.pack("<IQQI", 768, 0, 0, 0),
            "holds an unknown block, b'bvx2': it is damaged",
        ),
        ("depth", b"bvx-" + struct.pack("<I", 768) + bytes(700), "is cut short"),
        ("depth", b"bvxq" + bytes(100), "holds an unknown block, b'bvxq'"),
        ("conf", bytes(768), "holds 768 bytes, expected 192"),
        ("conf", bytes([3]) * 192, "levels up to 3; expected 16 x 12 and at most 2"),
        ("jpg", b"none", "not a readable image"),
    ],
)
def test_a_damaged_file_is_a_bad_frame(tmp_path: Path, file: str, data: bytes, problem: str) -> None:
    folder = write_record3d(tmp_path / "walk", CONTENT)
    (folder / f"rgbd/1.{file}").write_bytes(data)
    dataset = open_dataset(folder)
    bad_frame(dataset, 1, f"{folder / 'rgbd' / f'1.{file}'}: ", problem)
    dataset.read(2)


def test_a_pose_that_is_none_is_a_bad_frame(tmp_path: Path) -> None:
    poses = [[0, 0, 0, 1, 0, 0, 0.5], [0, 0, 0, 0, 1, 1, 1], [None, 0, 0, 1, 0, 0, 0]]
    dataset = open_dataset(write_record3d(tmp_path / "walk.r3d", CONTENT, poses=poses))
    dataset.read(0)
    bad_frame(dataset, 1, "walk.r3d: metadata: pose 1: the quaternion")
    bad_frame(dataset, 2, "pose 2:", "not finite")


def test_a_member_that_claims_too_much_is_not_unpacked(tmp_path: Path) -> None:
    good = write_record3d(tmp_path / "good.r3d", CONTENT)
    path = tmp_path / "walk.r3d"
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in old.namelist():
            archive.writestr(name, bytes(100_000_000) if name == "rgbd/0.depth" else old.read(name))
    dataset = open_dataset(path)
    bad_frame(dataset, 0, "claims 100,000,000 bytes; at most 5,632 are expected")
    dataset.read(1)


def test_metadata_may_unpack_to_what_the_file_s_size_lets_expect(tmp_path: Path) -> None:
    """A hundred kilobytes may be a hundred megabytes of text, which are gigabytes of lists."""
    good = write_record3d(tmp_path / "good.r3d", CONTENT)
    path = tmp_path / "walk.r3d"
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in old.namelist():
            archive.writestr(name, b"[" + b"{}," * 40_000_000 if name == "metadata" else old.read(name))
    with pytest.raises(
        DatasetError, match=r"walk\.r3d: metadata unpacks to 0\.12 GB, too much for a file of"
    ):
        open_dataset(path)


@pytest.mark.parametrize(
    ("members", "problem"),
    [({"rgbd/0.depth": b""}, "metadata: the file is missing"), ({"metadata": b"{}"}, "contains no rgbd")],
)
def test_a_zip_of_something_else_is_named(tmp_path: Path, members: dict[str, bytes], problem: str) -> None:
    path = tmp_path / "walk.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    refused(path, str(path), problem)


def test_packed_blocks_tell_what_they_hold() -> None:
    compress = packer()
    for content in (FLOATS.tobytes(), bytes(10), bytes(1_000_000), np.random.default_rng(0).bytes(70_000)):
        packed = compress(content)
        assert held_bytes(packed) == len(content)
        assert unpacked(packed, len(content)) == content
        with pytest.raises(DatasetError, match=r"cut short|damaged"):
            unpacked(packed[:-4], len(content))


HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"


@pytest.fixture
def stray(tmp_path: Path) -> Path:
    return write_stray(tmp_path / "walk", CONTENT)


def test_depth_poses_and_camera(stray: Path) -> None:
    dataset = open_dataset(stray)
    assert (len(dataset), dataset.dropped) == (3, 0)
    camera = dataset.camera
    assert camera.shape == (192, 256)
    # A pixel of depth is a square of 7.5 pixels of colour: their middles and the rays to the corners agree.
    np.testing.assert_allclose(camera.directions(127.5, 95.5), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(camera.directions(255.5, 191.5), [960 / 1500, 720 / 1500, 1.0])
    for i, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.depth_m, np.resize(CONTENT.depth[i], (192, 256)) / 1000, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, CONTENT.poses[i], atol=1e-9)
        assert frame.stamp == pytest.approx(100 + 0.1 * i)
        assert frame.color is None


def test_confidence_of_stray_scanner_is_a_sigma(stray: Path) -> None:
    (stray / "confidence" / "000001.png").unlink()
    dataset = open_dataset(stray)
    np.testing.assert_allclose(
        dataset.read(0).sigma_m[:, :3], np.tile([np.inf, 0.02, 0.01], (192, 1)), rtol=1e-6
    )
    assert dataset.stated.pixel_sigma
    assert dataset.read(1).sigma_m is None  # it has that of the format
    assert dataset.read(2).sigma_m is not None
    assert with_recorded_noise(Config(), dataset).sensor == SensorConfig(sigma=(0.01,))
    assert any("assumed for a phone's lidar" in note for note in dataset.notes)


def test_images_of_stray_scanner_without_a_pose_are_dropped(stray: Path) -> None:
    lines = (stray / "odometry.csv").read_text().splitlines()
    (stray / "odometry.csv").write_text("\n".join([*lines[:2], "", lines[3]]))
    dataset = open_dataset(stray)
    assert (dataset.frame_names, dataset.dropped) == (["000000", "000002"], 1)


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("odometry.csv", "", "lacks the column timestamp"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz\n", "lacks the column qw"),
        ("odometry.csv", HEADER + "1, 0, 0, 0\n", "line 2: expected 9 numbers"),
        ("odometry.csv", HEADER + "1,99,0,0,0,0,0,0,1\n", "a pose for none"),
        ("camera_matrix.csv", "1, 2, 3\n4, 5\n", "expected a 3 x 3 matrix"),
        ("camera_matrix.csv", "-9, 0, 3\n0, -9, 3\n0, 0, 1\n", "must be positive"),
    ],
)
def test_damaged_files_are_named(stray: Path, file: str, text: str, problem: str) -> None:
    (stray / file).write_text(text)
    refused(stray, str(stray / file), problem)


@pytest.mark.parametrize("levels", [np.full((192, 256), 3, np.uint8), np.ones((96, 128), np.uint8)])
def test_confidence_that_does_not_fit_is_named(stray: Path, levels: np.ndarray) -> None:
    path = write_image(stray / "confidence" / "000000.png", levels)
    bad_frame(open_dataset(stray), 0, f"{path}: has ", " levels up to")
    open_dataset(stray).read(1)
