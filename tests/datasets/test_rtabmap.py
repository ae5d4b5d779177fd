"""Databases of RTAB-Map as recordings and as poses that change."""

import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import CAMERA
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import bad_frame, refused
from rtabmap_database import OPTICAL, Database, calibration, encoded, plain_calibration, rvl
from scipy.spatial.transform import Rotation

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.formats.rtabmap import RtabmapDatabase, decode_depth, node_camera
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

RANDOM = np.random.default_rng(5)
DEPTH = [RANDOM.integers(400, 9000, CAMERA.shape).astype(np.uint16) for _ in range(4)]
COLOR = RANDOM.integers(1, 256, (*CAMERA.shape, 3)).astype(np.uint8)


def pose() -> Pose:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=RANDOM).as_matrix(), RANDOM.normal(size=3)
    return T


BODY = [pose() for _ in range(4)]
OPTIMISED = {id: pose() for id in (1, 2, 4)}


def filled(path: Path, version: str = "0.21.4", camera: bytes | None = None) -> Database:
    database = Database(path, version)
    camera = calibration(CAMERA) if camera is None else camera
    for index, id in enumerate((1, 2, 3, 4)):
        database.add(id, 100.0 + index, BODY[index], encoded(DEPTH[index]), camera, encoded(COLOR))
    return database


def test_nodes_are_frames_at_the_odometry_s_poses(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    database = filled(path)
    database.add(5, 104.0, BODY[0], None, None)  # a node in between, without images
    database.add(6, 105.0, None, encoded(DEPTH[0]), calibration(CAMERA))  # and one that was lost
    dataset = open_dataset(path)
    assert format_name(path) == "RTAB-Map"
    assert list(dataset.frame_names) == ["000001", "000002", "000003", "000004"]
    assert list(dataset.stamps()) == [100.0, 101.0, 102.0, 103.0]
    assert dataset.dropped == 1
    assert dataset.camera == CAMERA
    assert "poses of the odometry: the database holds no optimised ones" in dataset.notes
    for index, frame in enumerate(dataset):
        np.testing.assert_array_equal(frame.depth_m, DEPTH[index].astype(np.float32) / np.float32(1000))
        np.testing.assert_array_equal(frame.color, COLOR)
        np.testing.assert_allclose(frame.T_world_camera, BODY[index] @ OPTICAL, atol=1e-6)
    assert open_dataset(path, color=False).read(0).color is None
    assert open_dataset(path, depth_scale=500.0).read(0).depth_m[0, 0] == np.float32(DEPTH[0][0, 0] / 500)
    named = open_dataset(path, intrinsics=(20.0, 20.0, 8.0, 6.0))
    assert named.read(0).camera == named.camera == PinholeCamera(16, 12, 20.0, 20.0, 8.0, 6.0)
    tracked = open_dataset(path, track=True)
    assert tracked.tracked
    assert len(tracked) == 5


@pytest.mark.parametrize("optimised", [False, True])
def test_of_sessions_that_are_not_optimised_the_longest_is_read(tmp_path: Path, optimised: bool) -> None:
    database = filled(tmp_path / "walk.db")
    for id in (7, 8):
        largest = np.full(CAMERA.shape, 65535, np.uint16)
        database.add(id, 200.0 + id, BODY[0], encoded(largest), calibration(CAMERA), session=1)
    if optimised:
        database.optimise({id: pose() for id in (1, 2, 3, 4, 7, 8)})
    dataset = open_dataset(tmp_path / "walk.db")
    assert (len(dataset), dataset.dropped) == ((6, 0) if optimised else (4, 2))
    said = " ".join(dataset.notes)
    assert ("session 0 (4 nodes) is read, not 1 (2 nodes)" in said) != optimised
    assert ("33% of the pixels of 3 frames looked at have the largest possible number" in said) == optimised


def test_optimised_poses_count_and_other_nodes_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    database = filled(path)
    database.optimise(OPTIMISED)
    information = np.diag(np.arange(1.0, 7.0))
    database.link(1, 2, 0, BODY[0], information)
    database.link(4, 1, 1, BODY[1], information)
    database.link(1, 1, 7, BODY[1], information)  # a prior of one node's pose
    dataset = open_dataset(path)
    assert list(dataset.frame_names) == ["000001", "000002", "000004"]
    assert dataset.dropped == 1
    assert dataset.notes[-2:] == [
        "poses as RTAB-Map last optimised them",
        "2 links between nodes, 1 of them close a loop",
    ]
    for frame, T in zip(dataset, OPTIMISED.values(), strict=True):
        np.testing.assert_allclose(frame.T_world_camera, T @ OPTICAL, atol=1e-6)
    assert RtabmapDatabase(path).link_types() == [0, 1]


def test_depth_may_be_float_and_smaller_than_the_colour_image(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    database = Database(path, "0.11.8")
    metres = (DEPTH[0] / 1000).astype(np.float32)[::2, ::2]
    metres[0, 0] = np.nan
    database.add(1, 0.0, BODY[0], encoded(metres), plain_calibration(CAMERA), encoded(COLOR))
    dataset = open_dataset(path)
    assert dataset.camera == PinholeCamera(8, 6, 7.0, 7.5, 3.75, 2.75)
    frame = dataset.read(0)
    assert frame.camera == dataset.camera
    assert frame.depth_m[0, 0] == 0.0
    np.testing.assert_array_equal(frame.depth_m[1:], metres[1:])
    np.testing.assert_array_equal(frame.color, COLOR[::2, ::2])
    np.testing.assert_allclose(frame.T_world_camera, BODY[0] @ OPTICAL, atol=1e-6)


def test_depth_may_be_packed_as_rvl_or_inverse(tmp_path: Path) -> None:
    holes = np.where(RANDOM.random(CAMERA.shape) < 0.4, 0, DEPTH[0]).astype(np.uint16)
    holes[-1] = 65534
    for image in (DEPTH[0], holes, np.zeros_like(holes)):
        np.testing.assert_array_equal(decode_depth(rvl(image), "here", 1.0), image.astype(np.float32))
        data = rvl(image)
        for cut in (data[:-8], data[:17], data[:12]):
            with pytest.raises(DatasetError, match="here: "):
                decode_depth(cut, "here", 1.0)
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
    metres = holes.clip(0, 9999) / 1000.0
    steps = np.where(metres > 0, np.rint(a / np.maximum(metres, 0.1) + b), 0).astype(np.uint16)
    for inner in (rvl(steps), encoded(steps)):
        found = decode_depth(b"DEPTHINV" + struct.pack("<2f", a, b) + inner, "here", 1000.0)
        np.testing.assert_allclose(found, metres, rtol=0.01)
    path = tmp_path / "walk.db"
    Database(path).add(1, 0.0, BODY[0], rvl(holes), calibration(CAMERA))
    np.testing.assert_allclose(open_dataset(path).read(0).depth_m, holes / 1000.0, rtol=1e-6)


def test_rectified_cameras_have_no_lens_and_others_are_undistorted(tmp_path: Path) -> None:
    lens = (0.1, -0.2, 0.001, 0.0, 0.0)
    bent = node_camera(calibration(CAMERA, lens=lens), (0, 21, 4), "here")
    assert bent.distortion == lens
    assert node_camera(calibration(CAMERA, lens=lens, rectified=True), (0, 21, 4), "here").distortion == ()
    filled(tmp_path / "walk.db", camera=calibration(CAMERA, lens=lens))
    assert any("undistorted" in note for note in open_dataset(tmp_path / "walk.db").notes)


def test_poses_change_when_the_database_is_optimised(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    database = filled(path)
    dataset = open_posed(path, path, follow=True)
    for index in range(4):
        np.testing.assert_allclose(dataset.read(index).T_world_camera, BODY[index] @ OPTICAL, atol=1e-6)
    assert not dataset.poses.renew()
    database.optimise(OPTIMISED)
    assert dataset.poses.renew()
    np.testing.assert_allclose(dataset.read(3).T_world_camera, OPTIMISED[4] @ OPTICAL, atol=1e-6)
    # A transaction under way is not seen, and a locked database is read later.
    writer = sqlite3.connect(path, isolation_level=None)
    writer.execute("BEGIN EXCLUSIVE")
    writer.execute("UPDATE Admin SET opt_ids = NULL, opt_poses = NULL")
    assert not dataset.poses.renew()
    writer.execute("COMMIT")
    assert dataset.poses.renew()
    np.testing.assert_allclose(dataset.read(3).T_world_camera, BODY[3] @ OPTICAL, atol=1e-6)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (calibration(CAMERA, kind=1), "node 1: holds a stereo pair"),
        (2 * calibration(CAMERA), "node 1: holds images of several cameras"),
        (calibration(CAMERA)[:-8], "node 1: the calibration is cut short"),
        (b"\xff" * 60, "node 1: the calibration is damaged"),
        (calibration(CAMERA, lens=(0.1,) * 6), "node 1: the lens has 6 coefficients"),
        (calibration(CAMERA, T_body_camera=2 * np.eye(4)), "node 1: the rotation of a pose is not one"),
    ],
)
def test_cameras_that_cannot_be_read_are_named(tmp_path: Path, camera: bytes, words: str) -> None:
    filled(tmp_path / "walk.db", camera=camera)
    refused(tmp_path / "walk.db", words)


def test_damaged_files_and_images_are_named(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    path.write_bytes(b"no database at all" * 100)
    refused(path, "walk.db: cannot be read as an RTAB-Map database")
    path.unlink()
    sqlite3.connect(path).executescript("CREATE TABLE Node (id INTEGER)")
    refused(path, "walk.db: not an RTAB-Map database: it lacks the table Data, Admin")
    path.unlink()
    database = filled(path)
    database.connection.execute("UPDATE Data SET depth = ? WHERE id = 2", (encoded(DEPTH[1])[:-20],))
    database.connection.execute("UPDATE Data SET image = ? WHERE id = 3", (b"JPEG, perhaps",))
    database.connection.commit()
    dataset = open_dataset(path)
    bad_frame(dataset, 1, "walk.db: node 2: depth: the image is cut short")
    bad_frame(dataset, 2, "walk.db: node 3: image: not a readable image")
    assert dataset.read(3).name == "000004"
    database.connection.execute("UPDATE Data SET depth = ? WHERE id = 1", (b"DEPTHLZ4" * 9,))
    database.connection.commit()
    refused(path, "node 1: the depth image is of an unknown format")
    database.connection.execute("UPDATE Data SET depth = NULL")
    database.connection.commit()
    refused(path, "no node has a depth image")


blobs = st.none() | st.integers(-5, 5) | st.text(max_size=4) | st.binary(max_size=70)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    place=st.sampled_from(
        [
            "Node.pose",
            "Node.stamp",
            "Data.calibration",
            "Data.depth",
            "Admin.opt_ids",
            "Admin.opt_poses",
            "Link.transform",
            "Admin.version",
        ]
    ),
    value=blobs,
)
def test_any_value_is_read_or_refused(tmp_path: Path, place: str, value: object) -> None:
    path = tmp_path / "walk.db"
    path.unlink(missing_ok=True)
    database = filled(path)
    database.optimise(OPTIMISED)
    database.link(1, 2, 0, BODY[0], np.eye(6))
    table, _, column = place.partition(".")
    database.connection.execute(f"UPDATE {table} SET {column} = ?", (value,))
    database.connection.commit()
    database.connection.close()
    problem = str(path)
    try:
        for frame in open_dataset(path):
            assert np.isfinite(frame.T_world_camera).all()
    except DatasetError as error:
        problem = str(error)
    assert str(path) in problem


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


@pytest.mark.parametrize(
    ("table", "made"),
    [
        (
            "Data",
            "VIEW Data AS SELECT 1 AS id, zeroblob(900000000) AS depth, 0 AS image, 0 AS calibration",
        ),
        ("Link", f"VIEW Link AS {ENDLESS} SELECT i AS from_id, 0 AS to_id, 1 AS type, 0 AS transform FROM n"),
        ("Node", f"VIEW Node AS {ENDLESS} SELECT i AS id, 0 AS map_id, 0 AS stamp, NULL AS pose FROM n"),
        ("Data", "TABLE Data (id, image, calibration, depth AS (zeroblob(900000000)))"),
        ("Link", "VIRTUAL TABLE Link USING fts5(from_id, to_id, type, transform)"),
    ],
)
def test_a_table_whose_rows_are_computed_is_refused(tmp_path: Path, table: str, made: str) -> None:
    """A file of a few kilobytes has rows and bytes without end there."""
    path = tmp_path / "walk.db"
    filled(path)
    with sqlite3.connect(path) as connection:
        connection.execute(f"DROP TABLE {table}")
        connection.execute(f"CREATE {made}")
    connection.close()
    with pytest.raises(DatasetError, match=rf"walk\.db: not an RTAB-Map database: {table} (is no|has col)"):
        open_dataset(path)
