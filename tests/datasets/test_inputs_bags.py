"""Bags of all three kinds, read back; what is chosen in them, what is left out, and what is said of bad
ones."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from console import FAST, mapped, report_of
from datasets_recordings import write_stamped
from inputs_bags import (
    BODY,
    CAMERA,
    COUNT,
    FRAME,
    INFO,
    START,
    TOPIC,
    Bag,
    Kind,
    Make,
    T_body_camera,
    check_poses,
    data_file,
    images,
    mounted,
    moving_tf,
    odometry,
    plain,
    rvl,
    stamp,
    stamped_poses,
    steps,
    world_body,
)
from inputs_frames import moved
from refusals import bad_frame, refused
from rosbags.typesys import get_types_from_msg

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.images import decode_rvl
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import inverse, look_at
from taichi_mrf.sensor.camera import PinholeCamera

KINDS: tuple[Kind, ...] = ("ros1", "sqlite", "mcap")
Write = Callable[[Bag], None]
UNSIZED = SimpleNamespace(**vars(CAMERA) | {"width": 0, "height": 0})
OTHER = PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5)
LENS = (-0.2, 0.05, 0.001, -0.002, 0.0)

own_poses = partial(odometry, child=FRAME)
"""Poses of the camera itself."""
uninformed = partial(images, info=False)
"""Images without a CameraInfo."""


def informed(*more: object, **options: object) -> Write:
    """A CameraInfo of the images."""
    return lambda bag: bag.camera_info(INFO, FRAME, *(more or (CAMERA,)), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("inside", [False, True], ids=["as it is", "the file in the folder"])
def test_every_kind_comes_back(make: Make, kind: Kind, inside: bool) -> None:
    path = make(plain, kind=kind)
    dataset = open_dataset(data_file(path) if inside else path)
    assert (dataset.camera, len(dataset), dataset.dropped) == (CAMERA, COUNT, 0)
    assert list(dataset.frame_names) == [f"{i:06d}" for i in range(COUNT)]
    for i in (3, 0, 4, 1, 2):
        frame = dataset.read(i)
        np.testing.assert_array_equal(frame.depth_m, steps(i).astype(np.float32) / np.float32(1000))
        assert frame.stamp == pytest.approx(START + stamp(i), abs=1e-6)
    check_poses(dataset)
    assert any(BODY in note and FRAME in note for note in dataset.notes)


@pytest.mark.parametrize("big", [False, True], ids=["little-endian", "big-endian"])
def test_encodings(make: Make, big: bool) -> None:
    exact = steps(0) / np.float32(1000)
    missing = np.where(steps(0) > 0, exact, np.nan).astype(np.float32)
    missing[1, 1] = np.inf

    def write(bag: Bag) -> None:
        bag.image("/a/depth", 1.0, FRAME, steps(0), "16UC1", big)
        bag.image("/b/depth", 1.0, FRAME, missing, "32FC1", big)
        bag.compressed_depth("/c/depth/compressedDepth", 1.0, FRAME, steps(0))
        bag.image("/e/depth", 1.0, FRAME, steps(0), "mono16", big)
        bag.pose_stamped("/camera/pose", 1.0, "map", np.eye(4))

    path = make(informed(), write)
    halved = open_dataset(f"{path}?depth=/a/depth", depth_scale=2000.0).read(0).depth_m
    np.testing.assert_allclose(halved, exact / 2, rtol=1e-6)
    refused(path, "?depth=/a/depth", "?depth=/b/depth", "?depth=/c/depth/compressedDepth", "?depth=/e/depth")
    for topic in ("/a/depth", "e/depth", "/b/depth"):
        exact[1, 1] = 0 if topic == "/b/depth" else exact[1, 1]
        np.testing.assert_array_equal(open_dataset(f"{path}?depth={topic}").read(0).depth_m, exact)


T_body_link = look_at([0.2, -0.1, 0.3], [1.0, 0.2, 0.1])
T_link_optical = look_at([0.0, 0.02, 0.0], [0.1, 1.0, 0.3])
T_body_optical = T_body_link @ T_link_optical
DISPLACEMENT, TURN = (0.03, 0.02, -0.01), (0.01, -0.02, 0.05)
"""How far the body moves, in metres, and turns, in radians, in the 20 ms to either side of an image."""


def mounting(bag: Bag) -> None:
    bag.tf("/tf_static", 0.0, BODY, "link", T_body_link)
    bag.tf("/tf_static", 0.0, "link", FRAME, T_link_optical)


def as_odometry(bag: Bag) -> None:
    """16UC1 images, and Odometry 20 ms before and after each, which the body passes on a straight line."""
    images(bag)
    for i in range(COUNT):
        for sign in (-1, 1):
            T = moved(world_body(i), DISPLACEMENT, TURN, sign)
            bag.odometry("/odom", stamp(i) + 0.02 * sign, "map", BODY, T)


def as_poses(bag: Bag) -> None:
    """32FC1 images, and PoseStamped of a body that is not named."""
    metres = [np.where(steps(i) > 0, steps(i) / np.float32(1000), np.float32(np.nan)) for i in range(COUNT)]
    images(bag, image=metres.__getitem__, encoding="32FC1")
    stamped_poses(bag, "/tracker/pose")


def as_tf(bag: Bag) -> None:
    """compressedDepth images, and a chain of two moving and two fixed transforms; colour and infrared
    beside."""
    informed()(bag)
    bag.camera_info("/cam/color/camera_info", "color_optical", CAMERA)
    for i in range(COUNT):
        T_map_odom = look_at([0.1 * i, 0.0, 0.0], [1.0, 0.1 * i, 0.0])
        bag.tf("/tf", stamp(i), "map", "odom", T_map_odom)
        bag.tf("/tf", stamp(i), "odom", BODY, inverse(T_map_odom) @ world_body(i))
        bag.image("/cam/color/image_raw", stamp(i), "color_optical", np.zeros((12, 16, 3), np.uint8), "rgb8")
        bag.image("/cam/infra1/image_rect_raw", stamp(i), FRAME, np.ones((12, 16), np.uint16), "mono16")
        bag.compressed_depth("/cam/depth/image_raw/compressedDepth", stamp(i), FRAME, steps(i))


@pytest.mark.parametrize(
    ("kind", "write", "rest"),
    [("ros1", as_odometry, ""), ("sqlite", as_poses, "/walk.db3"), ("mcap", as_tf, "?frame=map")],
)
def test_each_way_of_writing_gives_the_same_frames(make: Make, kind: Kind, write: Write, rest: str) -> None:
    dataset = open_dataset(f"{make(mounting, write, kind=kind)}{rest}")
    check_poses(dataset, mount=T_body_optical)
    for i, frame in enumerate(dataset):
        np.testing.assert_array_equal(frame.depth_m, steps(i) / np.float32(1000))


@pytest.mark.usefixtures("one_backend")
def test_a_bag_is_mapped_by_the_program(make: Make, tmp_path: Path) -> None:
    mapped(make(plain), "--out", tmp_path / "out", *FAST, "--evaluation.hold-out", "0")
    report = report_of(tmp_path / "out")
    assert (report["keyframes"], report["dropped_frames"]) == (COUNT, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_out_of_the_tree(make: Make, kind: Kind) -> None:
    def corrected(bag: Bag) -> None:
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), "map", "odom", look_at([0, 0, 0.1 * i], [1, 0, 0]))

    path = make(images, mounted, moving_tf, corrected, kind=kind)
    check_poses(open_dataset(f"{path}?pose=tf&frame=odom"))
    for i, frame in enumerate(open_dataset(path)):
        expected = look_at([0, 0, 0.1 * i], [1, 0, 0]) @ world_body(i) @ T_body_camera
        np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-9)
    refused(f"{path}?frame=nowhere", "tf has no frame 'nowhere'; its frames: base_link, camera_depth")


def test_the_frame_of_a_topic_can_be_left_for_another(make: Make) -> None:
    T_map_odom = look_at([5, 0, 0], [6, 1, 0])
    path = make(plain, partial(mounted, parent="map", child="odom", T=T_map_odom))
    check_poses(open_dataset(f"{path}?frame=map"), T_map_odom)


def test_a_pose_without_a_mounting_is_not_taken_for_the_cameras(make: Make) -> None:
    path = make(images, odometry)
    said = f"topic /odom: the poses are of {BODY}, and no transform leads to {FRAME}"
    refused(path, said, f"?body={FRAME}")
    named = make(images, partial(odometry, child="camera"), name="camera")
    for source, note in (
        (f"{path}?body={FRAME}", f", of {FRAME}"),
        (named, "assumed to be of the camera itself"),
    ):
        dataset = open_dataset(source)
        check_poses(dataset, mount=np.eye(4))
        assert any(note in each for each in dataset.notes)


def test_a_mounting_that_is_sent_now_and_then_holds_all_the_time(make: Make) -> None:
    def now_and_then(bag: Bag) -> None:
        for seconds in (0.2, 1.2):
            bag.tf("/tf", seconds, BODY, FRAME, T_body_camera)

    check_poses(open_dataset(make(images, moving_tf, now_and_then)))


@pytest.mark.parametrize("frame", ["", "cam"])
def test_images_of_a_frame_that_tf_lacks_name_the_remedy(make: Make, frame: str) -> None:
    path = make(partial(images, frame=frame), mounted, moving_tf)
    said = refused(path, f"?optical=FRAME; tf has {BODY}, {FRAME}, odom")
    assert "contains no poses" not in said
    check_poses(open_dataset(f"{path}?optical={FRAME}"))


def test_the_camera_of_another_frame_is_not_taken(make: Make) -> None:
    def write(bag: Bag) -> None:
        images(bag, "/camera/aligned/image_raw", info=False)
        own_poses(bag)
        bag.camera_info("/camera/aligned/camera_info", "another_frame", OTHER)

    path = make(write)
    refused(path, f"are of the frame {FRAME}, but the CameraInfo of /camera/aligned/camera_info")
    assert open_dataset(f"{path}?info=/camera/aligned/camera_info").camera == OTHER
    both = make(write, lambda bag: bag.camera_info("/elsewhere/camera_info", FRAME, CAMERA), name="both")
    assert open_dataset(both).camera == CAMERA


def test_depth_of_the_plain_transport_is_found_as_png_and_refused_as_jpeg(make: Make) -> None:
    def compressed(bag: Bag) -> None:
        for suffix, words in (("png", "png"), ("jpg", "jpeg")):
            for i in range(COUNT):
                image = steps(i) if suffix == "png" else (steps(i) // 256).astype(np.uint8)
                bag.compressed(
                    f"/cam/{suffix}/compressed", stamp(i), FRAME, image, f"16UC1; {words} compressed "
                )

    path = make(compressed, own_poses, lambda bag: bag.camera_info("/cam/camera_info", FRAME, CAMERA))
    np.testing.assert_allclose(open_dataset(path).read(2).depth_m, steps(2) / 1000, rtol=1e-6)
    refused(f"{path}?depth=/cam/jpg/compressed", "JPEG keeps only 8 bits")


@pytest.mark.parametrize("packing", ["compressedDepth", "compressedDepth png", "compressedDepth rvl"])
@pytest.mark.parametrize("kind", ["16UC1", "mono16", "32FC1"])
def test_depth_of_the_depth_transport_in_its_formats(make: Make, kind: str, packing: str) -> None:
    image = steps(0)
    image[3, 4:11] = image[-1, -5:] = 0
    metres = image / np.float32(1000)

    def packed(bag: Bag) -> None:
        bag.camera_info("/cam/depth/camera_info", FRAME, CAMERA)
        depth = metres if kind == "32FC1" else image
        bag.compressed_depth("/cam/depth/compressedDepth", stamp(0), FRAME, depth, kind, packing)

    dataset = open_dataset(make(packed, own_poses))
    assert dataset.camera == CAMERA
    found = dataset.read(0).depth_m
    # 32FC1 has inverse depths as whole numbers of 1 / 10100 per metre.
    np.testing.assert_allclose(found, metres, atol=9.0**2 / 10100 / 2 * 1.01 if kind == "32FC1" else 0)
    np.testing.assert_array_equal(found == 0, image == 0)


@pytest.mark.parametrize("packing", ["compressedDepth zdepth", "tiff compressed"])
def test_depth_in_an_unknown_format_is_refused_by_its_name(make: Make, packing: str) -> None:
    def write(bag: Bag) -> None:
        bag.compressed_depth("/cam/depth/compressedDepth", stamp(0), FRAME, steps(0), "16UC1", packing)

    refused(make(write, odometry), f"topic /cam/depth/compressedDepth: encoding '16UC1; {packing}'")


@pytest.mark.parametrize("cut", [-1, 7, 12, 30])
def test_damaged_rvl_is_refused(cut: int) -> None:
    data = rvl(steps(0))
    with pytest.raises(DatasetError, match="RVL"):
        decode_rvl(data[:cut] if cut > 0 else b"\x01\0\0\0\x01\0\0\0" + b"\xff" * 40)


def test_the_body_of_a_pose_can_be_named(make: Make) -> None:
    T_marker_body = look_at([0, 0, 1], [1, 0, 1])
    marked = partial(mounted, parent="marker", child=BODY, T=T_marker_body)
    path = make(images, mounted, marked, partial(stamped_poses, topic="/pose"))
    check_poses(open_dataset(path), mount=T_marker_body @ T_body_camera)
    check_poses(open_dataset(f"{path}?body={BODY}"))
    check_poses(open_dataset(f"{path}?body={FRAME}"), mount=np.eye(4))


def test_poses_from_a_file(make: Make, tmp_path: Path) -> None:
    stamps = [START + stamp(i) for i in range(COUNT)]
    poses = write_stamped(tmp_path / "track.txt", stamps, map(world_body, range(COUNT)))
    dataset = open_dataset(f"{make(images)}?poses={poses}")
    np.testing.assert_allclose(dataset.read(1).T_world_camera, world_body(1), atol=1e-6)


def test_poses_can_be_left_to_be_tracked(make: Make) -> None:
    path = make(images)
    for dataset in (open_dataset(f"{path}?poses=track"), open_dataset(path, track=True)):
        assert dataset.tracked
        assert (len(dataset), dataset.dropped) == (COUNT, 0)
        np.testing.assert_array_equal(dataset.read(0).T_world_camera, dataset.read(1).T_world_camera)


def test_images_without_poses_are_left_out_and_counted(make: Make) -> None:
    def poses(bag: Bag) -> None:
        for seconds in (1.08, 1.12, 1.19, 1.32):
            bag.pose_stamped("/camera/pose", seconds, "map", look_at([seconds, 0, 0], [9, 0, 0]))

    path = make(images, poses)
    dataset = open_dataset(path, max_time_gap=0.05)
    assert (list(dataset.frame_names), dataset.dropped) == (["000001"], 4)
    assert dataset.read(0).T_world_camera[0, 3] == pytest.approx(1.1, abs=1e-6)
    assert any(f"4 of 5 images of {TOPIC} dropped" in note for note in dataset.notes)
    wider = open_dataset(path, max_time_gap=0.13)
    assert list(wider.frame_names) == ["000001", "000002", "000003"]
    words = (f"none of 5 images of {TOPIC}", "within 0.001 s", "/pose: 1600000001.080 to 1600000001.320 s")
    refused(path, *words, max_time_gap=0.001)


def test_broken_poses_are_left_out_and_counted(make: Make) -> None:
    not_finite = np.eye(4)
    not_finite[0, 3] = np.nan
    dataset = open_dataset(make(plain, lambda bag: bag.odometry("/odom", 1.15, "odom", BODY, not_finite)))
    assert len(dataset) == COUNT
    assert any("1 messages of /odom left out" in note for note in dataset.notes)


def test_the_distortion_of_a_camera_is_undone_unless_told_otherwise(make: Make) -> None:
    path = make(uninformed, own_poses, informed(CAMERA, LENS))
    told = open_dataset(path, undistort=LENS).read(0).depth_m
    as_they_are = open_dataset(path, undistort=(0.0, 0.0, 0.0, 0.0)).read(0).depth_m
    np.testing.assert_array_equal(open_dataset(path).read(0).depth_m, told)
    np.testing.assert_array_equal(as_they_are, steps(0) / np.float32(1000))
    assert (told != as_they_are).any()


def test_rectified_images_have_the_projections_camera(make: Make) -> None:
    rectified = PinholeCamera(16, 12, 13.0, 13.5, 8.0, 6.0)

    def write(bag: Bag) -> None:
        for topic in ("/camera/image_rect", "/camera/image_raw"):
            images(bag, topic, info=False)
        bag.camera_info("/camera/camera_info", FRAME, CAMERA, LENS, projection=rectified)

    path = make(write, own_poses)
    dataset = open_dataset(f"{path}?depth=/camera/image_rect")
    assert (dataset.camera, dataset.distortion) == (rectified, ())
    assert open_dataset(f"{path}?depth=/camera/image_raw").camera == CAMERA


def test_without_a_camera_the_user_can_give_one(make: Make) -> None:
    path = make(uninformed, odometry, mounted)
    refused(path, "--camera fx,fy,cx,cy")
    assert open_dataset(path, intrinsics=(14.0, 15.0, 7.5, 5.5)).camera == CAMERA


def test_several_cameras_are_chosen_among(make: Make) -> None:
    def two(bag: Bag) -> None:
        bag.camera_info("/camera/a/camera_info", FRAME, CAMERA)
        bag.camera_info("/camera/b/camera_info", FRAME, OTHER)

    path = make(uninformed, own_poses, two)
    refused(path, "?info=/camera/a/camera_info or ?info=/camera/b/camera_info")
    assert open_dataset(f"{path}?info=/camera/b/camera_info").camera == OTHER


def send_zeros(bag: Bag) -> None:
    """The CameraInfo of a driver that does not know its camera."""
    camera = PinholeCamera(16, 12, 1.0, 1.0, 0.0, 0.0)
    object.__setattr__(camera, "fx", 0.0)
    object.__setattr__(camera, "fy", 0.0)
    bag.camera_info(INFO, FRAME, camera)


def test_each_image_has_the_camera_of_its_time(make: Make) -> None:
    small = PinholeCamera(8, 6, 7.0, 7.5, 3.5, 2.5)
    cameras = [CAMERA, CAMERA, OTHER, small, small][:COUNT]

    def write(bag: Bag) -> None:
        for i, camera in enumerate(cameras):
            bag.camera_info(INFO, FRAME, camera, stamp=stamp(i))
            bag.image(TOPIC, stamp(i), FRAME, steps(i)[: camera.height, : camera.width], "16UC1")

    dataset = open_dataset(make(own_poses, send_zeros, write))
    assert dataset.camera == CAMERA
    assert [frame.camera for frame in dataset] == cameras
    changes = f"the camera changes {len(set(cameras)) - 1} times"
    said = f"{changes}, according to its CameraInfo: from frame 000002 on fx is "
    assert f"{said}{OTHER.fx:g}, before {CAMERA.fx:g}" in dataset.notes


def only_color(bag: Bag) -> None:
    bag.camera_info("/camera/color/camera_info", FRAME, CAMERA)
    bag.image("/camera/color/image_raw", 1.0, FRAME, np.zeros((12, 16, 3), np.uint8), "rgb8")
    own_poses(bag)


def livox(bag: Bag) -> None:
    name = "livox_ros_driver2/msg/CustomMsg"
    bag.types.register(get_types_from_msg("uint32 point_num", name))
    bag.send("/livox/lidar", name, 1.0, point_num=0)
    own_poses(bag)


BAD: dict[str, tuple[tuple[Write, ...], str, tuple[str, ...]]] = {
    "no depth": ((only_color,), "", ("topics of depth images", "16UC1", "/camera/color/image_raw (rgb8)")),
    "Livox": ((livox,), "", ("nor of point clouds", "/livox/lidar (CustomMsg)", "xfer_format 0")),
    "colour as depth": (
        (only_color,),
        "?depth=/camera/color/image_raw",
        ("topic /camera/color/image_raw", "'rgb8' is not depth", "16UC1"),
    ),
    "no such topic": ((plain,), "?depth=/nowhere", ("no topic /nowhere", TOPIC)),
    "not an image": ((plain,), "?depth=/odom", ("topic /odom", "nav_msgs/msg/Odometry")),
    "no poses": ((images,), "", ("contains no poses", "?poses=FILE")),
    "no such pose": ((plain,), "?pose=/nowhere", ("no topic /nowhere", "/odom")),
    "not a pose": ((plain,), f"?pose={TOPIC}", (f"topic {TOPIC}", "PoseStamped")),
    "no such tree": ((images, odometry), "?pose=tf", (f"tf has no frame '{FRAME}'", "none")),
    "two poses": (
        (plain, partial(odometry, topic="/vio")),
        "",
        ("several topics of poses", "?pose=/odom or ?pose=/vio"),
    ),
    "no such option": ((plain,), "?topic=/odom", ("unknown parameter 'topic'",)),
    "no such body": ((plain,), "?body=trailer", ("no frame 'trailer'",)),
    "info without a size": (
        (uninformed, own_poses, informed(cast(PinholeCamera, UNSIZED))),
        "",
        (INFO, "0 x 0 pixels", "--camera 14,15,7.5,5.5"),
    ),
    "uncalibrated": ((uninformed, own_poses, send_zeros), "", (INFO, "not calibrated", "--camera")),
    "a lens that is not OpenCV's": (
        (uninformed, own_poses, informed(CAMERA, (0.1, 0.0, 0.0, 0.1), "equidistant")),
        "",
        (INFO, "'equidistant'", "--undistort 0,0,0,0"),
    ),
    "a distorted camera that changes": (
        (
            uninformed,
            own_poses,
            informed(CAMERA, LENS, stamp=stamp(0)),
            informed(OTHER, LENS, stamp=stamp(1)),
        ),
        "",
        (f"the camera changes at {START + stamp(1):.3f} s and its lens is distorted; --camera",),
    ),
    "of Intel's library": (
        (partial(uninformed, topic="/device_0/sensor_0/Depth_0/image/data"),),
        "",
        ("RealSense", "realsense:", "?poses=FILE"),
    ),
}


@pytest.mark.parametrize("problem", BAD)
def test_what_cannot_be_chosen_is_said_in_one_line(make: Make, problem: str) -> None:
    parts, query, words = BAD[problem]
    path = make(*parts)
    refused(f"{path}{query}", str(path), *words)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_a_bag_that_is_cut_short_is_named(make: Make, kind: Kind, share: float) -> None:
    path = make(plain, kind=kind)
    file = data_file(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert refused(file).startswith(str(file))
    refused(path, str(path))


@pytest.mark.parametrize(("turned", "quarters"), [("turned-left", 1), ("turned-right", 3)])
@pytest.mark.parametrize("smaller", [1, 2])
def test_turned_images_of_a_camera_that_is_not_are_read_with_the_flag_and_refused_without(
    make: Make, turned: str, quarters: int, smaller: int
) -> None:
    """CameraInfo states the sensor's size; images may be smaller copies."""

    def stored(i: int) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(steps(i)[::smaller, ::smaller], quarters))

    path = make(partial(images, image=stored), odometry, mounted)
    refused(path, "the CameraInfo of", "--image-is turned-left")
    dataset = open_dataset(path, image_is=turned)
    assert dataset.camera == CAMERA.scaled(1 / smaller)
    for i, frame in enumerate(dataset):
        assert frame.camera == dataset.camera
        np.testing.assert_allclose(frame.depth_m, steps(i)[::smaller, ::smaller] / 1000, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, world_body(i) @ T_body_camera, atol=1e-9)


def test_a_damaged_image_is_a_broken_frame(make: Make) -> None:
    def damaged(bag: Bag) -> None:
        bag.image(TOPIC, 1.05, FRAME, steps(0)[:6], "16UC1")
        bag.image(TOPIC, 1.25, FRAME, steps(0).astype(np.uint8), "8UC1")

    dataset = open_dataset(make(plain, damaged))
    assert len(dataset) == COUNT + 2
    bad_frame(dataset, 1, f"topic {TOPIC}: ", " 16 x 6 pixels")
    bad_frame(dataset, 4, "walk.bag: topic ", "'8UC1' is not depth")
    assert (dataset.read(5).depth_m > 0).any()


@pytest.mark.parametrize("kind", KINDS)
def test_messages_of_one_moment_are_kept_apart(make: Make, kind: Kind) -> None:
    """A recorder that wrote them out together gave them one time; their headers tell them apart."""

    def burst(bag: Bag) -> None:
        for i in range(COUNT):
            bag.latency = 3.0 - stamp(i)
            images(bag, info=False, numbers=[i])

    dataset = open_dataset(make(mounted, own_poses, informed(), burst, kind=kind))
    for i in (4, 0, 2):
        np.testing.assert_array_equal(dataset.read(i).depth_m, steps(i).astype(np.float32) / np.float32(1000))
