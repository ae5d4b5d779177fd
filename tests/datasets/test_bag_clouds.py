"""Point clouds in bags: fields by name, rings, times, poses, images of beams and columns; and what is wrong
with them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_clouds import (
    CAMERA,
    LIDAR,
    LOST,
    POSED,
    SCANS,
    SWEEPS_WITHOUT_POSES,
    T_BODY_LIDAR,
    drive,
    points,
    pose,
    send,
    stamp,
    sweeps,
    write,
)
from inputs_bags import Bag, Kind, Make, mounted, plain
from numpy.typing import NDArray
from point_clouds import in_order
from refusals import bad_frame, refused

from taichi_mrf.cli.main import main
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.ros.lidar import LidarBag, by_ring, decode, organised
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.origins import starts_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.spherical import SphericalCamera


def cloud(*what: Any, **more: Any) -> Callable[[Bag], None]:
    """A part of a bag: one cloud."""
    return lambda bag: send(bag, *what, **more)


@pytest.mark.parametrize(("kind", "big"), [("ros1", False), ("sqlite", True), ("mcap", False)])
def test_a_cloud_with_rows_is_an_image(tmp_path: Path, kind: Kind, big: bool) -> None:
    dataset = open_dataset(write(tmp_path, kind, big=big))
    assert isinstance(dataset, LidarBag)
    assert (len(dataset), dataset.dropped, dataset.stated.reach_m) == (SCANS, 0, 10.0)
    for scan, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.camera.rays(), CAMERA.rays(), atol=1e-5)
        np.testing.assert_array_equal(frame.no_return, LOST)
        expected = np.linalg.norm(points(scan), axis=-1)
        np.testing.assert_allclose(frame.depth_m[~LOST], expected[~LOST], rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, pose(stamp(scan)) @ T_BODY_LIDAR, atol=1e-3)
    assert "/points: images of 24 x 4 rays" in dataset.notes


def test_rings_make_an_image_and_other_points_free_rays(make: Make) -> None:
    ring, known = np.repeat(np.arange(4, dtype=np.uint16), 24)[::-1][None], ~LOST.reshape(-1)
    flat = points(0).reshape(1, -1, 3)
    some = cloud(stamp(1), flat[:, known], ring=ring[:, known])
    image, free = open_dataset(make(cloud(stamp(0), flat, ring=ring), some, drive, kind="mcap"))
    assert image.camera.shape == CAMERA.shape
    np.testing.assert_allclose(image.camera.rays(), CAMERA.rays(), atol=1e-5)
    assert isinstance(free.camera, RayTable)
    assert not free.camera.has_pattern
    assert free.no_return is None
    found = free.camera.rays() * free.depth_m[..., None]
    np.testing.assert_allclose(in_order(found), in_order(flat[0][known]), atol=1e-5)


@pytest.mark.parametrize("unit", ["t", "time", "timestamp"])
def test_each_column_of_a_scan_has_its_pose(make: Make, unit: str) -> None:
    """Walls that stand still are seen from where the lidar is at the time of each column."""
    seconds = np.tile(np.linspace(-0.04, 0.04, 24), (4, 1))
    where = np.array([pose(stamp(0) + s) @ T_BODY_LIDAR for s in seconds[0]])
    T_world_stamp = pose(stamp(0)) @ T_BODY_LIDAR
    still = points(0) @ T_world_stamp[:3, :3].T + T_world_stamp[:3, 3]
    seen = np.einsum("wji,hwj->hwi", where[:, :3, :3], still - where[:, :3, 3])
    times = {
        "t": ((seconds + 0.04) * 1e9).astype(np.uint32),
        "time": seconds.astype(np.float32),
        "timestamp": 1_600_000_000.0 + stamp(0) + seconds,
    }
    first = stamp(0) - 0.04 if unit == "t" else stamp(0)  # unsigned: from the beginning of the scan
    path = make(cloud(first, seen, **{unit: times[unit]}), drive, kind="mcap")
    frame = open_dataset(path).read(0)
    T, camera = frame.T_world_camera, frame.camera
    assert isinstance(camera, RayTable)
    assert camera.has_pattern
    np.testing.assert_array_equal(frame.no_return, LOST)
    found = frame.points_m @ T[:3, :3].T + T[:3, 3]
    off = np.linalg.norm(found - still, axis=-1)[~LOST]
    assert off.max() < 0.02, "poses are interpolated on chords"
    starts = starts_at(camera, np.arange(24), 0) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(starts, where[:, :3, 3], atol=1e-3)
    assert not any("deskew" in note for note in open_dataset(path).notes)
    skewed = open_dataset(f"{path}?deskew=false").read(0)
    assert skewed.no_return is not None
    np.testing.assert_allclose(skewed.depth_m[~LOST], np.linalg.norm(seen, axis=-1)[~LOST], rtol=1e-5)


def test_a_motion_that_is_left_in_though_points_have_times_is_told(make: Make) -> None:
    """The lidar drives at 1 m/s and turns by 0.5 rad/s: 0.1 m and 0.05 rad a scan, 0.6 m at 10 m."""

    def opened(query: str, **times: Any) -> LidarBag:
        scans = [cloud(stamp(scan), points(scan), **times) for scan in range(SCANS)]
        dataset = open_dataset(f"{make(*scans, drive, kind='mcap')}{query}")
        assert isinstance(dataset, LidarBag)
        return dataset

    times = np.tile(np.linspace(-0.04, 0.04, 24, dtype=np.float32), (4, 1))
    said = "/points: the lidar moves by 0.6"
    left_in, undone = opened("?deskew=false", time=times), opened("", time=times)
    assert left_in.notes[-1].startswith(said)
    assert left_in.notes[-1].endswith("leave out deskew=false")
    assert left_in.stated.swept_m == pytest.approx(0.6, abs=0.03)
    assert undone.stated.swept_m == 0.0
    for other in (undone, opened(""), opened("?deskew=false", time=0 * times)):
        assert not any(said in note for note in other.notes)


@pytest.mark.parametrize("kind", SWEEPS_WITHOUT_POSES)
def test_a_scan_with_points_that_have_no_pose_is_left_out(make: Make, kind: str) -> None:
    first_s, last_s, posed, kept = SWEEPS_WITHOUT_POSES[kind]
    path = make(partial(sweeps, first_s=first_s, last_s=last_s, posed=posed), kind="mcap")
    dataset = open_dataset(path)
    assert (dataset.frame_names, dataset.dropped) == (kept, 1)
    said = "1 of 3 clouds of /points dropped: none has poses, at most 0.2 s apart, from its first point to"
    assert sum(note.startswith(said) for note in dataset.notes) == 1
    whole = make(partial(sweeps, first_s=first_s, last_s=last_s, posed=POSED), kind="mcap", name="whole")
    undone = {frame.name: frame for frame in open_dataset(whole)}
    assert len(undone) == 3
    for frame in dataset:
        np.testing.assert_array_equal(frame.points_m, undone[frame.name].points_m)
    rigid = open_dataset(f"{path}?deskew=false")
    assert (len(rigid), rigid.dropped) == (3, 0)


def test_poses_as_far_apart_as_around_a_stamp_undo_motion(make: Make) -> None:
    """Odometry at 10 Hz that misses one pose; the last cloud ends at the last pose."""
    posed = np.delete(np.arange(15, 42) / 10, 16)  # without 3.1 s
    path = make(partial(sweeps, first_s=0.0, last_s=0.1, posed=posed), kind="mcap")
    dataset = open_dataset(path)
    assert (len(dataset), dataset.dropped) == (3, 0)
    whole = make(partial(sweeps, first_s=0.0, last_s=0.1, posed=POSED), kind="mcap", name="whole")
    for ours, theirs in zip(dataset, open_dataset(whole), strict=True):
        assert np.linalg.norm(ours.points_m - theirs.points_m, axis=-1).max() < 0.02


@pytest.mark.parametrize(
    ("at", "said"),
    [
        ((2.0, 3.0, 4.0), "the lidar moves by 0.59 m in a scan, turns counted at 10 m, which is not"),
        ((2.0,), "the lidar's motion in a scan is not undone, though"),
    ],
)
def test_poses_at_the_stamps_alone_leave_motion_in_which_is_told(
    make: Make, at: tuple[float, ...], said: str
) -> None:
    dataset = open_dataset(make(partial(sweeps, first_s=0.0, last_s=0.08, posed=at, at=at), kind="mcap"))
    assert (len(dataset), dataset.dropped) == (len(at), 0)
    for i, frame in enumerate(dataset):
        expected = np.linalg.norm(points(i), axis=-1)
        np.testing.assert_allclose(frame.depth_m[~LOST], expected[~LOST], rtol=1e-6)
    (note,) = (note for note in dataset.notes if "not undone" in note)
    assert note.startswith(f"/points: {said}")
    assert note.endswith("denser poses are needed, or a larger --max-time-gap")


TIMES = np.tile(np.linspace(0.0, 0.08, CAMERA.width, dtype=np.float32), (CAMERA.height, 1))

WITHOUT_TIMES = {
    "broken": (points(3)[:, :0], TIMES[:, :0]),
    "empty": (np.full_like(points(3), np.nan), TIMES),
    "at one time": (points(3), 0 * TIMES),
}
"""Clouds, and times of their points, for which no pose is asked besides that at the stamp."""


@pytest.mark.parametrize("kind", WITHOUT_TIMES)
def test_a_cloud_without_times_is_no_proof_that_poses_are_dense(make: Make, kind: str) -> None:
    """Poses at the stamps alone: the other clouds stay, with their motion in them."""
    at, (values, times) = (2.0, 3.0, 4.0, 5.0), WITHOUT_TIMES[kind]
    sparse = partial(sweeps, first_s=0.0, last_s=0.08, posed=at, at=at[:3])
    dataset = open_dataset(make(sparse, cloud(5.0, values, time=times), kind="mcap"))
    assert list(dataset.frame_names) == [f"{i:06d}" for i in range(4)]
    assert dataset.dropped == 0
    (note,) = (note for note in dataset.notes if "not undone" in note)
    assert note.endswith("denser poses are needed, or a larger --max-time-gap")


def test_nothing_is_told_of_motion_where_the_lidar_stands_still_at_first(make: Make) -> None:
    def path(at: float) -> NDArray[np.float64]:
        return pose(max(0.0, at - 2.5))

    at = tuple(np.arange(20, 40) / 10)
    dataset = open_dataset(
        make(partial(sweeps, first_s=0.0, last_s=0.08, posed=POSED, at=at, path=path), kind="mcap")
    )
    assert not any("not undone" in note for note in dataset.notes)
    assert dataset.stated.swept_m == 0.0


def test_free_rays_start_where_their_points_were_measured(make: Make) -> None:
    flat = points(0)[~LOST][None]
    seconds = np.linspace(-0.04, 0.04, flat.shape[1], dtype=np.float32)
    path = make(cloud(stamp(0), flat, time=seconds[None]), drive, kind="mcap")
    frame = open_dataset(path).read(0)
    assert isinstance(frame.camera, RayTable)
    assert not frame.camera.has_pattern
    poses = np.array([pose(stamp(0) + s) @ T_BODY_LIDAR for s in seconds])
    T, expected = frame.T_world_camera, (poses[:, :3, :3] @ flat[0][..., None])[..., 0] + poses[:, :3, 3]
    found = (frame.points_m @ T[:3, :3].T + T[:3, 3])[0]
    off = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(axis=1)
    assert off.max() < 0.02
    assert np.ptp(frame.camera.origins_m[..., 0]) > 0.05


def test_a_lidar_that_stands_still_keeps_its_image(make: Make) -> None:
    def still(bag: Bag) -> None:
        for i in range(5):
            bag.odometry("/odom", 0.9 + 0.1 * i, "odom", LIDAR, np.eye(4))

    times = np.tile(np.arange(24, dtype=np.uint32) * 4_000_000, (4, 1))
    path = make(cloud(1.0, points(0), t=times), still, kind="mcap")
    assert open_dataset(path).read(0).camera.shape == CAMERA.shape


@pytest.mark.parametrize("with_tf", [False, True])
def test_clouds_in_the_worlds_frame_are_cast_from_the_sensor(make: Make, with_tf: bool) -> None:
    def walk(bag: Bag) -> None:
        for at, xyz in ((stamp(scan), points(scan)) for scan in range(SCANS)):
            T_odom_lidar = pose(at)
            send(bag, at, xyz @ T_odom_lidar[:3, :3].T + T_odom_lidar[:3, 3], frame="odom")
            bag.odometry("/odom", at, "odom", "body", T_odom_lidar)
            if with_tf:
                bag.tf("/tf", at, "odom", "body", T_odom_lidar)

    dataset = open_dataset(make(walk, kind="mcap"))
    assert any("of body, from where the data were moved to odom" in note for note in dataset.notes)
    for scan, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.T_world_camera, pose(stamp(scan)), atol=1e-9)
        expected = np.linalg.norm(points(scan), axis=-1)[~LOST]
        np.testing.assert_allclose(np.sort(frame.depth_m[frame.depth_m > 0]), np.sort(expected), rtol=1e-5)


def test_depth_images_come_first_and_points_can_be_chosen(make: Make) -> None:
    path = make(plain, cloud(stamp(0), points(0)), partial(mounted, child=LIDAR, T=T_BODY_LIDAR), kind="mcap")
    assert open_dataset(path).read(0).depth_m.shape == (12, 16)
    chosen = open_dataset(f"{path}?points=/points")
    assert chosen.read(0).camera.shape == CAMERA.shape


def test_info_lists_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path)
    assert main(["info", str(path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "points, frame" in printed
    assert "RayTable, 24 x 4 rays" in printed
    assert f"taichi-mrf map {path} --out DIR" in printed


def test_what_cannot_be_opened_is_named(make: Make, tmp_path: Path) -> None:
    two = make(
        cloud(1.0, points(0), "/front/points"),
        cloud(1.0, points(0), "/rear/points"),
        drive,
        kind="mcap",
        name="two",
    )
    refused(
        two,
        "several topics of point clouds: choose one with ?points=/front/points or ?points=/rear/points",
    )
    refused(f"{two}?points=/odom", "topic /odom is of type nav_msgs/msg/Odometry")
    path = write(tmp_path)
    refused(path, "contains lidar scans; --depth-scale is for depth images", depth_scale=5.0)
    late = make(cloud(50.0, points(0)), drive, kind="mcap", name="late")
    refused(late, "none of 1 clouds of /points")


def test_a_broken_cloud_is_named_and_the_others_are_read(make: Make) -> None:
    broken = cloud(stamp(0), np.full((4, 24, 3), np.nan))
    dataset = open_dataset(make(broken, cloud(stamp(1), points(1)), drive, kind="mcap"))
    bad_frame(dataset, 0, "topic /points: none of 96 points is a measurement")
    assert dataset.camera == dataset.read(1).camera
    refused(make(broken, drive, kind="mcap"), "no cloud can be read: frame 000000")


class Message:
    """A PointCloud2 made by hand."""

    def __init__(self, **changed: object) -> None:
        fields = [type("Field", (), {"name": n, "offset": 4 * i, "datatype": 7}) for i, n in enumerate("xyz")]
        values = {
            "height": 1, "width": 2, "point_step": 12, "row_step": 24, "is_bigendian": False,
            "fields": fields, "data": np.arange(6, dtype="<f4").view(np.uint8),
        } | changed  # fmt: skip
        self.__dict__.update(values)


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"width": 3}, "24 bytes are too few for 3 x 1 points"),
        ({"height": 0}, "2 x 0 points"),
        ({"point_step": 8}, "field 'z' of type 7 lies outside a point"),
        ({"point_step": 0}, "points of 0 bytes"),
        ({"width": 1 << 30, "height": 1 << 30}, "are read"),
        ({"fields": []}, "has no field x, y, z, only none"),
        ({"height": 2, "width": 1, "row_step": 3}, "too few"),
    ],
)
def test_data_that_do_not_fit_the_fields_are_refused(changed: dict[str, object], problem: str) -> None:
    with pytest.raises(DatasetError, match=problem):
        decode(Message(**changed), 0.0)


def test_a_row_step_of_zero_is_that_of_one_row() -> None:
    cloud = decode(Message(row_step=0), 0.0)
    np.testing.assert_array_equal(cloud.points_m, [[[0, 1, 2], [3, 4, 5]]])


@pytest.mark.parametrize("times", [np.array([0.0, 9.0]), np.array([1e15, 2e15]), np.array([np.nan, np.nan])])
def test_times_that_are_far_from_the_stamp_are_not_believed(times: NDArray) -> None:
    fields = [*Message().fields, type("Field", (), {"name": "time", "offset": 12, "datatype": 8})]  # type: ignore[attr-defined]
    rows = np.zeros(2, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f8")]))
    rows["time"] = times
    cloud = decode(Message(fields=fields, point_step=20, row_step=40, data=rows.view(np.uint8)), 100.0)
    assert cloud.seconds is None


ELEVATIONS = np.linspace(0.4, -0.3, 6)
AZIMUTHS = 1.0 - 2 * np.pi * np.arange(32) / 32
NOTHING_BACK = np.random.default_rng(3).random((6, 32)) < 0.3


def lidar(offsets: NDArray | None = None) -> SphericalCamera:
    return SphericalCamera(ELEVATIONS, AZIMUTHS, offsets)


def scan(camera: SphericalCamera, nothing: float = np.nan) -> NDArray:
    """Points (H, W, 3) at random ranges, some without a return."""
    ranges = np.random.default_rng(1).uniform(2.0, 9.0, camera.shape)
    points = camera.rays() * ranges[..., None]
    points[NOTHING_BACK] = nothing
    return points


@pytest.mark.parametrize("nothing", [np.nan, 0.0])
@pytest.mark.parametrize("offsets", [None, np.array([0.05, -0.04, 0.0, 0.02, 0.06, -0.03])])
def test_all_rays_come_back(nothing: float, offsets: NDArray | None) -> None:
    camera = lidar(offsets)
    found = organised(scan(camera, nothing))
    assert found is not None
    image, numbers = found
    table, range_m = image.camera, image.range_m
    np.testing.assert_array_equal(image.no_return, NOTHING_BACK)
    np.testing.assert_array_equal(numbers, np.arange(NOTHING_BACK.size).reshape(NOTHING_BACK.shape))
    np.testing.assert_array_equal(range_m > 0, ~NOTHING_BACK)
    np.testing.assert_allclose(table.rays(), camera.rays(), atol=1e-6)
    np.testing.assert_allclose(
        (table.rays() * range_m[..., None])[~NOTHING_BACK], scan(camera)[~NOTHING_BACK], atol=1e-5
    )


def test_rows_that_are_whole_columns_ahead_are_shifted_back() -> None:
    camera = lidar()
    shifts = [0, 3, 0, -2, 9, 1]
    staggered = np.stack(
        [np.roll(row, shift, axis=0) for shift, row in zip(shifts, scan(camera), strict=True)]
    )
    found, plain = organised(staggered), organised(scan(camera))
    assert plain is not None
    rays = found[0].camera.rays()
    across = np.diff(np.unwrap(np.arctan2(rays[..., 1], rays[..., 0]), axis=0), axis=0)
    assert np.abs(across).max() < 1e-5, "a column has one azimuth"
    np.testing.assert_array_equal(found[0].no_return.sum(axis=1), NOTHING_BACK.sum(axis=1))
    ranges = (np.sort(each.range_m, axis=None) for each, _ in (found, plain))
    np.testing.assert_allclose(*ranges)
    points, measured = staggered.reshape(-1, 3)[found[1]], found[0].range_m > 0
    np.testing.assert_allclose(
        np.linalg.norm(points, axis=-1)[measured], found[0].range_m[measured], rtol=1e-6
    )


def test_a_row_without_a_return_lies_between_its_neighbours() -> None:
    points = scan(lidar())
    points[2] = np.nan
    found = organised(points)
    np.testing.assert_allclose(found[0].camera.rays()[2], lidar().rays()[2], atol=1e-6)


def test_points_in_no_order_are_no_image() -> None:
    points = scan(lidar()).reshape(-1, 3)
    assert organised(np.random.default_rng(2).permutation(points).reshape(6, 32, 3)) is None
    assert organised(points[None]) is None
    assert organised(np.full((6, 32, 3), np.nan)) is None
    part = scan(lidar())[:, :12]  # of a turn
    assert organised(part) is not None
    assert organised(np.stack([np.roll(row, 2 * i, axis=0) for i, row in enumerate(part)])) is None


def test_rings_make_an_image_if_they_are_equally_long() -> None:
    points = scan(lidar())
    ring = np.repeat(np.array([5, 4, 3, 2, 1, 0]), 32)
    order = np.argsort(np.tile(np.arange(32), 6), kind="stable")  # column by column, as drivers write
    numbers = by_ring(points.reshape(-1, 3)[order], ring[order])
    assert numbers is not None
    np.testing.assert_array_equal(points.reshape(-1, 3)[order][numbers], points)
    assert by_ring(points.reshape(-1, 3)[1:], ring[1:]) is None
    assert by_ring(points.reshape(-1, 3), np.zeros(192, int)) is None
