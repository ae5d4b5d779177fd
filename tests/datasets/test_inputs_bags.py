"""Bags of all three kinds, read back; what is chosen in them, what is left out, and what is said of bad
ones."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets_recordings import stamped_line
from inputs_bags import (
    BODY,
    CAMERA,
    COUNT,
    FRAME,
    START,
    Bag,
    Kind,
    T_body_camera,
    check_poses,
    images,
    mounted,
    odometry,
    plain,
    rvl,
    stamp,
    steps,
    world_body,
    writing,
)
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.images import decode_rvl
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.camera import PinholeCamera

KINDS: tuple[Kind, ...] = ("ros1", "sqlite", "mcap")
Write = Callable[[Bag], None]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("inside", [False, True], ids=["as it is", "the file in the folder"])
def test_every_kind_comes_back(make: Callable[..., Path], kind: Kind, inside: bool) -> None:
    path = make(plain, kind=kind)
    if inside and kind != "ros1":
        path = next(path.glob("*.mcap" if kind == "mcap" else "*.db3"))
    dataset = open_dataset(path)
    assert (dataset.camera, len(dataset), dataset.dropped) == (CAMERA, COUNT, 0)
    assert list(dataset.frame_names) == [f"{i:06d}" for i in range(COUNT)]
    for i in (3, 0, 4, 1, 2):
        frame = dataset.read(i)
        np.testing.assert_array_equal(frame.depth_m, steps(i).astype(np.float32) / np.float32(1000))
        np.testing.assert_allclose(frame.T_world_camera, world_body(i) @ T_body_camera, atol=1e-9)
        assert frame.stamp == pytest.approx(START + stamp(i), abs=1e-6)
    with pytest.raises(IndexError, match="5 frames"):
        dataset.read(COUNT)
    assert any(BODY in note and FRAME in note for note in dataset.notes)


@pytest.mark.parametrize("big", [False, True], ids=["little-endian", "big-endian"])
def test_encodings(make: Callable[..., Path], big: bool) -> None:
    metres = steps(0) / np.float32(1000)
    missing = np.where(steps(0) > 0, metres, np.nan).astype(np.float32)
    missing[1, 1] = np.inf

    def write(bag: Bag) -> None:
        for name in ("a", "b", "c", "d", "e"):
            bag.camera_info(f"/{name}/camera_info", FRAME, CAMERA)
        bag.image("/a/depth", 1.0, FRAME, steps(0), "16UC1", big)
        bag.image("/b/depth", 1.0, FRAME, missing, "32FC1", big)
        bag.compressed_depth("/c/depth/compressedDepth", 1.0, FRAME, steps(0))
        bag.compressed_depth("/d/depth/compressedDepth", 1.0, FRAME, metres, "32FC1")
        bag.image("/e/depth", 1.0, FRAME, steps(0), "mono16", big)
        bag.pose_stamped("/camera/pose", 1.0, "map", np.eye(4))

    path = make(write)
    exact = metres.copy()
    np.testing.assert_array_equal(open_dataset(f"{path}?depth=/a/depth").read(0).depth_m, exact)
    np.testing.assert_array_equal(open_dataset(f"{path}?depth=e/depth").read(0).depth_m, exact)
    compressed = open_dataset(f"{path}?depth=/c/depth/compressedDepth")
    assert compressed.camera == CAMERA
    np.testing.assert_array_equal(compressed.read(0).depth_m, exact)
    exact[1, 1] = 0
    np.testing.assert_array_equal(open_dataset(f"{path}?depth=/b/depth").read(0).depth_m, exact)
    # The plugin makes inverse depths whole numbers of 1 / 10100 per metre.
    quantised = open_dataset(f"{path}?depth=/d/depth/compressedDepth").read(0).depth_m
    np.testing.assert_allclose(quantised, metres, atol=9.0**2 / 10100 / 2 * 1.01)
    assert quantised[0, 0] == 0
    halved = open_dataset(f"{path}?depth=/a/depth", depth_scale=2000.0).read(0).depth_m
    np.testing.assert_allclose(halved, metres / 2, rtol=1e-6)
    said = refused(path)
    for name in ("/a/depth", "/b/depth", "/c/depth/compressedDepth", "/d/depth/compressedDepth", "/e/depth"):
        assert f"?depth={name}" in said


@pytest.mark.parametrize("kind", KINDS)
def test_poses_out_of_the_tree(make: Callable[..., Path], kind: Kind) -> None:
    def write(bag: Bag) -> None:
        images(bag)
        mounted(bag)
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), "map", "odom", look_at([0, 0, 0.1 * i], [1, 0, 0]))
            bag.tf("/tf", stamp(i), "odom", BODY, world_body(i))

    path = make(write, kind=kind)
    for query, base in (("", True), ("?pose=tf&frame=odom", False)):
        dataset = open_dataset(f"{path}{query}")
        for i in range(COUNT):
            expected = world_body(i) @ T_body_camera
            if base:
                expected = look_at([0, 0, 0.1 * i], [1, 0, 0]) @ expected
            np.testing.assert_allclose(dataset.read(i).T_world_camera, expected, atol=1e-9)
    refused(f"{path}?frame=nowhere", "tf has no frame 'nowhere'; its frames: base_link, camera_depth")


def test_the_frame_of_a_topic_can_be_left_for_another(make: Callable[..., Path]) -> None:
    T_map_odom = look_at([5, 0, 0], [6, 1, 0])
    path = make(plain, lambda bag: bag.tf("/tf_static", 0.0, "map", "odom", T_map_odom))
    frame = open_dataset(f"{path}?frame=map").read(1)
    np.testing.assert_allclose(frame.T_world_camera, T_map_odom @ world_body(1) @ T_body_camera, atol=1e-9)


def test_a_pose_without_a_mounting_is_not_taken_for_the_cameras(make: Callable[..., Path]) -> None:
    path = make(images, odometry)
    refused(
        path,
        f"topic /odom: the poses are of {BODY}, and no transform from there to {FRAME} is in the bag",
        f"?body={FRAME}",
    )
    named = make(images, lambda bag: odometry(bag, child="camera"), name="camera")
    for source, note in (
        (f"{path}?body={FRAME}", f", of {FRAME}"),
        (named, "assumed to be of the camera itself"),
    ):
        dataset = open_dataset(str(source))
        np.testing.assert_allclose(dataset.read(1).T_world_camera, world_body(1), atol=1e-9)
        assert any(note in each for each in dataset.notes)


def test_a_mounting_that_is_sent_now_and_then_holds_all_the_time(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        images(bag)
        for i in range(COUNT):
            bag.tf("/tf", stamp(i), "odom", BODY, world_body(i))
        for seconds in (0.2, 1.2):
            bag.tf("/tf", seconds, BODY, FRAME, T_body_camera)

    check_poses(open_dataset(make(write)))


@pytest.mark.parametrize("frame", ["", "cam"])
def test_images_of_a_frame_that_tf_lacks_name_the_remedy(make: Callable[..., Path], frame: str) -> None:
    def write(bag: Bag) -> None:
        bag.camera_info("/camera/depth/camera_info", frame, CAMERA)
        mounted(bag)
        for i in range(COUNT):
            bag.image("/camera/depth/image_raw", stamp(i), frame, steps(i), "16UC1")
            bag.tf("/tf", stamp(i), "odom", BODY, world_body(i))

    path = make(write)
    refused(path, f"?optical=FRAME says which of tf's frames ({BODY}, {FRAME}, odom) is the sensor's")
    dataset = open_dataset(f"{path}?optical={FRAME}")
    np.testing.assert_allclose(dataset.read(1).T_world_camera, world_body(1) @ T_body_camera, atol=1e-9)


def test_the_camera_of_another_frame_is_not_taken(make: Callable[..., Path]) -> None:
    other = PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5)

    def write(bag: Bag) -> None:
        images(bag, "/camera/aligned/image_raw", info=False)
        odometry(bag, child=FRAME)
        bag.camera_info("/camera/aligned/camera_info", "another_frame", other)

    path = make(write)
    refused(path, f"are of the frame {FRAME}, but the CameraInfo of /camera/aligned/camera_info")
    assert open_dataset(f"{path}?info=/camera/aligned/camera_info").camera == other
    both = make(write, lambda bag: bag.camera_info("/elsewhere/camera_info", FRAME, CAMERA), name="both")
    assert open_dataset(both).camera == CAMERA


def test_depth_of_the_plain_transport_is_found_as_png_and_refused_as_jpeg(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        bag.camera_info("/cam/depth/camera_info", FRAME, CAMERA)
        odometry(bag, child=FRAME)
        for kind in ("png", "jpg"):
            for i in range(COUNT):
                image = steps(i) if kind == "png" else (steps(i) // 256).astype(np.uint8)
                data = np.frombuffer(cv2.imencode(f".{kind}", image)[1].tobytes(), np.uint8)
                header, words = (
                    bag.header(stamp(i), FRAME),
                    f"16UC1; {kind.replace('jpg', 'jpeg')} compressed ",
                )
                topic = f"/cam/depth/{kind}/compressed"
                bag.send(
                    topic, "sensor_msgs/msg/CompressedImage", stamp(i), header=header, format=words, data=data
                )

    path = make(write)
    np.testing.assert_allclose(open_dataset(path).read(2).depth_m, steps(2) / 1000, rtol=1e-6)
    refused(f"{path}?depth=/cam/depth/jpg/compressed", "JPEG keeps 8 bits")


@pytest.mark.parametrize(
    ("kind", "packing"),
    [
        ("16UC1", "compressedDepth"),
        ("16UC1", "compressedDepth rvl"),
        ("mono16", "compressedDepth png"),
        ("32FC1", "compressedDepth"),
        ("32FC1", "compressedDepth rvl"),
    ],
)
def test_depth_of_the_depth_transport_in_its_formats(
    make: Callable[..., Path], kind: str, packing: str
) -> None:
    image = steps(0)
    image[3, 4:11] = image[-1, -5:] = 0
    metres = image / np.float32(1000)

    def write(bag: Bag) -> None:
        bag.camera_info("/cam/depth/camera_info", FRAME, CAMERA)
        depth = metres if kind == "32FC1" else image
        bag.compressed_depth("/cam/depth/compressedDepth", stamp(0), FRAME, depth, kind, packing)

    found = open_dataset(make(write, lambda bag: odometry(bag, child=FRAME))).read(0).depth_m
    # 32FC1 has inverse depths as whole numbers of 1 / 10100 per metre.
    np.testing.assert_allclose(found, metres, atol=9.0**2 / 10100 / 2 * 1.01 if kind == "32FC1" else 0)
    np.testing.assert_array_equal(found == 0, image == 0)


@pytest.mark.parametrize("packing", ["compressedDepth zdepth", "tiff compressed"])
def test_depth_in_an_unknown_format_is_refused_by_its_name(make: Callable[..., Path], packing: str) -> None:
    def write(bag: Bag) -> None:
        bag.compressed_depth("/cam/depth/compressedDepth", stamp(0), FRAME, steps(0), "16UC1", packing)

    refused(make(write, odometry), f"topic /cam/depth/compressedDepth: encoding '16UC1; {packing}'")


@pytest.mark.parametrize("cut", [-1, 7, 12, 30])
def test_damaged_rvl_is_refused(cut: int) -> None:
    data = rvl(steps(0))
    with pytest.raises(DatasetError, match="RVL"):
        decode_rvl(data[:cut] if cut > 0 else b"\x01\0\0\0\x01\0\0\0" + b"\xff" * 40)


def test_the_body_of_a_pose_can_be_named(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        images(bag)
        mounted(bag)
        bag.tf("/tf_static", 0.0, "marker", BODY, look_at([0, 0, 1], [1, 0, 1]))
        for i in range(COUNT):
            bag.pose_stamped("/pose", stamp(i), "world", world_body(i))

    path = make(write)
    T_marker_body = look_at([0, 0, 1], [1, 0, 1])
    for query, T_pose_camera in (
        ("", T_marker_body @ T_body_camera),
        (f"?body={BODY}", T_body_camera),
        (f"?body={FRAME}", np.eye(4)),
    ):
        frame = open_dataset(f"{path}{query}").read(2)
        np.testing.assert_allclose(frame.T_world_camera, world_body(2) @ T_pose_camera, atol=1e-9)


def test_poses_from_a_file(make: Callable[..., Path], tmp_path: Path) -> None:
    poses = tmp_path / "track.txt"
    poses.write_text("\n".join(stamped_line(START + stamp(i), world_body(i)) for i in range(COUNT)))
    path = make(images)
    dataset = open_dataset(f"{path}?poses={poses}")
    np.testing.assert_allclose(dataset.read(1).T_world_camera, world_body(1), atol=1e-6)


def test_poses_can_be_left_to_be_tracked(make: Callable[..., Path]) -> None:
    path = make(images)
    for dataset in (open_dataset(f"{path}?poses=track"), open_dataset(path, track=True)):
        assert dataset.tracked
        assert (len(dataset), dataset.dropped) == (COUNT, 0)
        np.testing.assert_array_equal(dataset.read(0).T_world_camera, dataset.read(1).T_world_camera)


def test_images_without_poses_are_left_out_and_counted(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        images(bag)
        for seconds in (1.08, 1.12, 1.19, 1.32):
            bag.pose_stamped("/camera/pose", seconds, "map", look_at([seconds, 0, 0], [9, 0, 0]))

    path = make(write)
    dataset = open_dataset(path, max_time_gap=0.05)
    assert (list(dataset.frame_names), dataset.dropped) == (["000001"], 4)
    assert dataset.read(0).T_world_camera[0, 3] == pytest.approx(1.1, abs=1e-6)
    assert any("4 of 5 images of /camera/depth/image_raw dropped" in note for note in dataset.notes)
    wider = open_dataset(path, max_time_gap=0.13)
    assert list(wider.frame_names) == ["000001", "000002", "000003"]
    refused(
        path,
        "none of 5 images of /camera/depth/image_raw",
        "within 0.001 s",
        "/pose: 1600000001.080 to 1600000001.320 s",
        max_time_gap=0.001,
    )


def test_broken_poses_are_left_out_and_counted(make: Callable[..., Path]) -> None:
    def not_finite(bag: Bag) -> None:
        T = np.eye(4)
        T[0, 3] = np.nan
        bag.odometry("/odom", 1.15, "odom", BODY, T)

    dataset = open_dataset(make(plain, not_finite))
    assert len(dataset) == COUNT
    assert any("1 messages of /odom left out" in note for note in dataset.notes)


def test_the_distortion_of_a_camera_is_undone_unless_told_otherwise(make: Callable[..., Path]) -> None:
    lens = (-0.2, 0.05, 0.001, -0.002, 0.0)

    def write(bag: Bag) -> None:
        images(bag, info=False)
        odometry(bag, child=FRAME)
        bag.camera_info("/camera/depth/camera_info", FRAME, CAMERA, lens)

    path = make(write)
    told = open_dataset(path, undistort=lens).read(0).depth_m
    as_they_are = open_dataset(path, undistort=(0.0, 0.0, 0.0, 0.0)).read(0).depth_m
    np.testing.assert_array_equal(open_dataset(path).read(0).depth_m, told)
    np.testing.assert_array_equal(as_they_are, steps(0) / np.float32(1000))
    assert (told != as_they_are).any()


def test_rectified_images_have_the_projections_camera(make: Callable[..., Path]) -> None:
    rectified = PinholeCamera(16, 12, 13.0, 13.5, 8.0, 6.0)

    def write(bag: Bag) -> None:
        for topic in ("/camera/image_rect", "/camera/image_raw"):
            images(bag, topic, info=False)
        odometry(bag, child=FRAME)
        bag.camera_info(
            "/camera/camera_info", FRAME, CAMERA, (-0.2, 0.05, 0.0, 0.0, 0.0), "plumb_bob", rectified
        )

    path = make(write)
    dataset = open_dataset(f"{path}?depth=/camera/image_rect")
    assert (dataset.camera, dataset.distortion) == (rectified, ())
    assert open_dataset(f"{path}?depth=/camera/image_raw").camera == CAMERA


def test_a_lens_that_is_not_opencvs_is_named(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        images(bag, info=False)
        odometry(bag, child=FRAME)
        bag.camera_info("/camera/depth/camera_info", FRAME, CAMERA, (0.1, 0.0, 0.0, 0.1), "equidistant")

    refused(make(write), "/camera/depth/camera_info", "'equidistant'", "--undistort 0,0,0,0")


def test_without_a_camera_the_user_can_give_one(make: Callable[..., Path]) -> None:
    path = make(lambda bag: images(bag, info=False), odometry, mounted)
    refused(path, "--camera fx,fy,cx,cy")
    dataset = open_dataset(path, intrinsics=(14.0, 15.0, 7.5, 5.5))
    assert dataset.camera == CAMERA


def test_several_cameras_are_chosen_among(make: Callable[..., Path]) -> None:
    other = PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5)

    def write(bag: Bag) -> None:
        images(bag, "/camera/depth/image_raw", info=False)
        odometry(bag, child=FRAME)
        bag.camera_info("/camera/a/camera_info", FRAME, CAMERA)
        bag.camera_info("/camera/b/camera_info", FRAME, other)

    path = make(write)
    refused(path, "?info=/camera/a/camera_info or ?info=/camera/b/camera_info")
    assert open_dataset(f"{path}?info=/camera/b/camera_info").camera == other


def send_zeros(bag: Bag) -> None:
    """The CameraInfo of a driver that does not know its camera."""
    camera = PinholeCamera(16, 12, 1.0, 1.0, 0.0, 0.0)
    object.__setattr__(camera, "fx", 0.0)
    object.__setattr__(camera, "fy", 0.0)
    bag.camera_info("/camera/depth/camera_info", FRAME, camera)


def test_each_image_has_the_camera_of_its_time(make: Callable[..., Path]) -> None:
    zoomed = PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5)
    small = PinholeCamera(8, 6, 7.0, 7.5, 3.5, 2.5)
    cameras = [CAMERA, CAMERA, zoomed, small, small][:COUNT]

    def write(bag: Bag) -> None:
        odometry(bag, child=FRAME)
        send_zeros(bag)
        for i, camera in enumerate(cameras):
            bag.camera_info("/camera/depth/camera_info", FRAME, camera, stamp=stamp(i))
            bag.image(
                "/camera/depth/image", stamp(i), FRAME, steps(i)[: camera.height, : camera.width], "16UC1"
            )

    dataset = open_dataset(make(write))
    assert dataset.camera == CAMERA
    assert [frame.camera for frame in dataset] == cameras
    assert f"the camera changes {len(set(cameras)) - 1} times, by its CameraInfo" in dataset.notes


def test_a_distorted_camera_that_changes_is_refused(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        images(bag, info=False)
        odometry(bag, child=FRAME)
        for i, focal in enumerate((14.0, 20.0)):
            camera = PinholeCamera(16, 12, focal, focal, 7.5, 5.5)
            bag.camera_info("/camera/depth/camera_info", FRAME, camera, (0.1, 0, 0, 0, 0), stamp=stamp(i))

    refused(
        make(write), f"the camera changes at {START + stamp(1):.3f} s and its lens is distorted; --camera"
    )


def uncalibrated(bag: Bag) -> None:
    images(bag, info=False)
    odometry(bag, child=FRAME)
    send_zeros(bag)


def only_color(bag: Bag) -> None:
    bag.camera_info("/camera/color/camera_info", FRAME, CAMERA)
    bag.image("/camera/color/image_raw", 1.0, FRAME, np.zeros((12, 16, 3), np.uint8), "rgb8")
    odometry(bag, child=FRAME)


BAD: dict[str, tuple[tuple[Write, ...], str, tuple[str, ...]]] = {
    "no depth": ((only_color,), "", ("topics of depth images", "16UC1", "/camera/color/image_raw (rgb8)")),
    "colour as depth": (
        (only_color,),
        "?depth=/camera/color/image_raw",
        ("topic /camera/color/image_raw", "'rgb8' is not depth", "16UC1"),
    ),
    "no such topic": ((plain,), "?depth=/nowhere", ("no topic /nowhere", "/camera/depth/image_raw")),
    "not an image": ((plain,), "?depth=/odom", ("topic /odom", "nav_msgs/msg/Odometry")),
    "no poses": ((images,), "", ("contains no poses", "?poses=FILE")),
    "no such pose": ((plain,), "?pose=/nowhere", ("no topic /nowhere", "/odom")),
    "not a pose": (
        (plain,),
        "?pose=/camera/depth/image_raw",
        ("topic /camera/depth/image_raw", "PoseStamped"),
    ),
    "no such tree": (
        (images, odometry),
        "?pose=tf",
        ("tf has no frame 'camera_depth_optical_frame'", "none"),
    ),
    "two poses": (
        (plain, lambda bag: odometry(bag, "/vio")),
        "",
        ("several topics of poses", "?pose=/odom or ?pose=/vio"),
    ),
    "no such option": ((plain,), "?topic=/odom", ("unknown parameter 'topic'",)),
    "no such body": ((plain,), "?body=trailer", ("no frame 'trailer'",)),
    "uncalibrated": ((uncalibrated,), "", ("/camera/depth/camera_info", "not calibrated", "--camera")),
    "of Intel's library": (
        (lambda bag: images(bag, "/device_0/sensor_0/Depth_0/image/data", info=False),),
        "",
        ("RealSense", "realsense:", "?poses=FILE"),
    ),
}


@pytest.mark.parametrize("problem", BAD)
def test_what_cannot_be_chosen_is_said_in_one_line(make: Callable[..., Path], problem: str) -> None:
    parts, query, words = BAD[problem]
    path = make(*parts)
    refused(f"{path}{query}", str(path), *words)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_a_bag_that_is_cut_short_is_named(make: Callable[..., Path], kind: Kind, share: float) -> None:
    path = make(plain, kind=kind)
    file = path if kind == "ros1" else next(path.glob("walk.*"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    said = refused(file)
    assert said.startswith(str(file))
    if kind != "ros1":
        refused(path, str(path))


def test_a_damaged_image_is_a_broken_frame(make: Callable[..., Path]) -> None:
    def write(bag: Bag) -> None:
        plain(bag)
        bag.image("/camera/depth/image_raw", 1.05, FRAME, steps(0)[:6], "16UC1")
        bag.image("/camera/depth/image_raw", 1.25, FRAME, steps(0).astype(np.uint8), "8UC1")

    dataset = open_dataset(make(write))
    assert len(dataset) == COUNT + 2
    with pytest.raises(FrameError, match=r"frame 000001: .*topic /camera/depth/image_raw: .* 16 x 6 pixels"):
        dataset.read(1)
    with pytest.raises(FrameError, match=r"frame 000004: .*walk\.bag: topic .*'8UC1' is not depth"):
        dataset.read(4)
    assert (dataset.read(5).depth_m > 0).any()


def test_messages_of_one_moment_are_kept_apart(make: Callable[..., Path]) -> None:
    """A recorder that wrote them out together gave them one time; their headers tell them apart."""

    def write(bag: Bag) -> None:
        mounted(bag)
        odometry(bag, child=FRAME)
        bag.camera_info("/camera/depth/camera_info", FRAME, CAMERA)
        for i in range(COUNT):
            bag.latency = 3.0 - stamp(i)
            bag.image("/camera/depth/image_raw", stamp(i), FRAME, steps(i), "16UC1")

    for kind in KINDS:
        dataset = open_dataset(make(write, kind=kind, name=f"burst_{kind}"))
        for i in (4, 0, 2):
            np.testing.assert_array_equal(
                dataset.read(i).depth_m, steps(i).astype(np.float32) / np.float32(1000)
            )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("names", [("walk_0", "walk_1"), ("2026-11-25-10-00-00_0", "2026-11-25-10-00-03_1")])
def test_the_files_of_a_split_recording_are_read_together(
    tmp_path: Path, kind: Kind, names: tuple[str, str]
) -> None:
    """The mounting is in the first file only."""
    halves = (range(COUNT // 2), range(COUNT // 2, COUNT))
    suffix = {"ros1": ".bag", "sqlite": ".db3", "mcap": ".mcap"}[kind]
    folder = tmp_path / "rec"
    folder.mkdir()
    for number, (name, half) in enumerate(zip(names, halves, strict=True)):
        path = folder / (name + suffix) if kind == "ros1" else tmp_path / name
        with writing(path, kind) as bag:
            bag.camera_info("/camera/depth/camera_info", FRAME, CAMERA, stamp=stamp(half[0]))
            if number == 0:
                mounted(bag)
            for i in half:
                bag.image("/camera/depth/image_raw", stamp(i), FRAME, steps(i), "16UC1")
                bag.odometry("/odom", stamp(i), "odom", BODY, world_body(i))
        if kind != "ros1":
            (data,) = path.glob(f"*{suffix}")
            data.rename(folder / (name + suffix))
    dataset = open_dataset(folder)
    assert f"{names[0]}{suffix} to {names[1]}{suffix}: 2 files are read as one recording" in dataset.notes
    check_poses(dataset)
    for i in range(COUNT):
        np.testing.assert_allclose(dataset.read(i).depth_m, steps(i) / 1000, rtol=1e-6)


def test_numbered_bags_that_do_not_follow_each_other_are_several(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for number, later in enumerate((0.0, 60.0)):
        with writing(tmp_path / "runs" / f"run_{number}.bag", "ros1") as bag:
            bag.image("/camera/depth/image_raw", later, FRAME, steps(0), "16UC1")
    refused(
        tmp_path / "runs",
        "contains several recordings (run_1.bag begins 60.0 s after the end of the one before)",
        "pass one of: run_0.bag, run_1.bag",
    )


def test_a_folder_of_bags_names_them(make: Callable[..., Path], tmp_path: Path) -> None:
    make(plain)
    make(plain, kind="mcap", name="second")
    assert refused(tmp_path).endswith("pass one of: second, walk.bag")
