"""Bags that are not as a recorder of ROS 2 leaves them, recordings in several files, and data in the world's
frame, each read or refused with the remedy."""

import struct
from collections.abc import Callable
from functools import partial
from operator import eq
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bag_clouds
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from inputs_bags import (
    BODY,
    CAMERA,
    COUNT,
    EYES,
    FRAME,
    INFO,
    START,
    T_LINK_CAMERA,
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
    seen,
    stamp,
    steps,
    world_body,
    writing,
)
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.ros.sensor import camera_of
from taichi_mrf.datasets.ros.stamps import mended_stamps
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

T_MAP_ODOM = np.array([[0.0, -1, 0, 3], [1, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])


def in_map(bag: Bag) -> None:
    """Clouds that were moved to the frame map from the place of the body, and its path by tf."""
    for i in range(COUNT):
        T = T_MAP_ODOM @ world_body(i)
        bag_clouds.send(bag, stamp(i), bag_clouds.points(i) @ T[:3, :3].T + T[:3, 3], frame="map")


in_map_tf = partial(moving_tf, parent="map", T=T_MAP_ODOM)


def by_odometry(bag: Bag) -> None:
    odometry(bag)
    mounted(bag, "map", "odom", T_MAP_ODOM)


def by_both(bag: Bag) -> None:
    by_odometry(bag)
    moving_tf(bag)


def localised(bag: Bag) -> None:
    """The frame of the clouds moves itself in that of a localiser."""
    in_map_tf(bag)
    moving_tf(bag, "earth", child="map")


@pytest.mark.parametrize("poses", [in_map_tf, by_odometry, by_both, localised])
def test_clouds_in_the_fixed_frame_of_tf_are_cast_from_the_body(
    make: Make, poses: Callable[[Bag], None]
) -> None:
    dataset = open_dataset(make(in_map, poses, kind="mcap"))
    check_poses(dataset, T_MAP_ODOM, np.eye(4))
    ranges = np.sort(dataset.read(0).depth_m[dataset.read(0).depth_m > 0])
    expected = np.sort(np.linalg.norm(bag_clouds.points(0), axis=-1)[~bag_clouds.LOST])
    np.testing.assert_allclose(ranges, expected, atol=1e-4)


def test_of_several_bodies_in_the_frame_of_the_clouds_the_user_chooses(make: Make) -> None:
    path = make(in_map, in_map_tf, partial(moving_tf, parent="map", child="other"), kind="mcap")
    refused(path, "are in the fixed frame map", f"?body=FRAME, one of {BODY}, other")
    check_poses(open_dataset(f"{path}?body={BODY}"), T_MAP_ODOM, np.eye(4))


def raw_mcap(path: Path, profile: str, encoding: str, content: Callable[[Bag], None]) -> None:
    """An MCAP file without chunks and index, as programs other than rosbag2 write it, beside a channel of
    another kind."""

    def record(kind: int, data: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(data)) + data

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value.encode())) + value.encode()

    channels, sent, is_ros1 = {"/foxglove": ("foxglove.RawImage", "protobuf", "", "protobuf")}, [], False
    sent.append((0, "/foxglove", b"\x01"))
    is_ros1 = encoding == "ros1"
    with writing(path.with_suffix(".bag" if is_ros1 else ""), "ros1" if is_ros1 else "mcap") as bag:

        def note(topic: str, name: str, at: float, message: object) -> None:
            definition = bag.types.generate_msgdef(name, ros_version=1 if is_ros1 else 2)[0]
            name_there = name.replace("/msg/", "/") if is_ros1 else name
            channels[topic] = (name_there, "ros1msg" if is_ros1 else "ros2msg", definition, encoding)
            serialize = bag.types.serialize_ros1 if is_ros1 else bag.types.serialize_cdr
            sent.append((round((START + at) * 1e9), topic, bytes(serialize(message, name))))

        bag.record = note  # type: ignore[method-assign]
        content(bag)
    names, out = list(channels), b"\x89MCAP0\r\n" + record(1, text(profile) + text("test"))
    for i, (topic, (name, kind, definition, packed)) in enumerate(channels.items(), start=1):
        out += record(3, struct.pack("<H", i) + text(name) + text(kind) + text(definition))
        out += record(4, struct.pack("<HH", i, i) + text(topic) + text(packed) + text(""))
    for at, topic, data in sorted(sent, key=lambda each: each[0]):
        out += record(5, struct.pack("<HIQQ", names.index(topic) + 1, 0, at, at) + data)
    out += record(15, bytes(4)) + record(2, bytes(20)) + b"\x89MCAP0\r\n"
    path.write_bytes(out)


@pytest.mark.parametrize(("profile", "encoding"), [("", "cdr"), ("x", "cdr"), ("ros1", "ros1")])
def test_mcap_files_of_any_profile_are_read(tmp_path: Path, profile: str, encoding: str) -> None:
    raw_mcap(tmp_path / "walk.mcap", profile, encoding, plain)
    dataset = open_dataset(tmp_path / "walk.mcap")
    check_poses(dataset)
    np.testing.assert_allclose(dataset.read(2).depth_m, steps(2) / np.float32(1000))


def test_topics_of_another_encoding_in_the_metadata_are_passed_over(make: Make) -> None:
    path = make(plain, partial(odometry, topic="/other"), kind="mcap")
    text = (path / "metadata.yaml").read_text()
    before, mark, after = text.rpartition("serialization_format: cdr")
    assert mark
    (path / "metadata.yaml").write_text(f"{before}serialization_format: json{after}")
    check_poses(open_dataset(f"{path}?pose=/odom"))


def absent(path: Path) -> Path:
    data_file(path).rename(path / "other.mcap")
    return path


def cut(path: Path) -> Path:
    file = data_file(path)
    file.write_bytes(file.read_bytes()[:-100])
    return file


def pointer(path: Path) -> Path:
    (path / "walk.bag").write_text("version https://git-lfs.github.com/spec/v1\n")
    return path / "walk.bag"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (absent, ["metadata.yaml names files that are not there, walk.mcap: add them"]),
        (pointer, ["is not a bag, despite its name; maybe a git-lfs pointer"]),
        (cut, ["damaged or cut short", "mcap recover"]),
    ],
)
def test_a_bag_that_cannot_be_opened_says_why(
    make: Make, damage: Callable[[Path], Path], words: list[str]
) -> None:
    said = refused(damage(make(plain, kind="mcap")), *words)
    assert ("cut short" in said) == (damage is cut)


def but(bag: Bag, **changes: Any) -> None:
    """A plain bag with other images, or by another clock."""
    images(bag, **changes)
    odometry(bag)
    mounted(bag)


def other_kinds(bag: Bag) -> None:
    bag.image("/range", 1.0, FRAME, steps(0), "mono16")
    bag.image("/jet", 1.0, FRAME, np.zeros((12, 16, 3), np.uint8), "bgr8")


def slow(bag: Bag) -> None:
    images(bag)
    mounted(bag)
    odometry(bag, late=-0.05, numbers=(0, 10))


REFUSED: dict[str, tuple[Callable[[Bag], object], list[str]]] = {
    "encodings": (other_kinds, ["/jet (bgr8), /range (mono16). ?depth=/range reads"]),
    "millimetres": (
        lambda bag: but(bag, image=lambda i: steps(i).astype(np.float32), encoding="32FC1"),
        ["too much for metres: pass --depth-scale 1000"],
    ),
    "clocks": (lambda bag: but(bag, late=-1000.0), ["clocks of sensor and poses are 1000.000 s apart"]),
    "slow": (slow, ["poses are 1 s apart; --max-time-gap 1 "]),
    "path": (
        lambda bag: (images(bag), path_of(bag)),
        ["/path: its poses name no child frame", f"?body={FRAME}"],
    ),
}


def path_of(bag: Bag) -> None:
    poses = {stamp(i): world_body(i) @ T_body_camera for i in range(COUNT)}
    bag.path("/path", 2.0, "map", poses)


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_missing_is_named_with_the_remedy(make: Make, case: str) -> None:
    content, words = REFUSED[case]
    refused(make(content, kind="mcap"), *words)


def test_the_last_message_of_a_path_has_the_poses(make: Make) -> None:
    path = make(images, path_of, kind="mcap")
    check_poses(open_dataset(f"{path}?body={FRAME}"))


def test_a_mounting_that_is_no_pose_is_named(make: Make) -> None:
    path = make(images, odometry, partial(mounted, T=np.zeros((4, 4))), kind="mcap")
    refused(path, f"transform of {FRAME} in {BODY} is not finite", "quaternion is zero")


def test_signed_millimetres_and_the_largest_value(make: Make) -> None:
    def image(i: int) -> np.ndarray:
        depth = steps(i).astype(np.int16)
        depth[:2], depth[2] = np.iinfo(np.int16).max, -5
        return depth

    dataset = open_dataset(make(partial(but, image=image, encoding="16SC1"), kind="mcap"))
    said = "17% of the pixels of 3 frames looked at have the largest possible number"
    assert any(said in note for note in dataset.notes)
    expected = np.where(np.arange(12)[:, None] < 3, 0, steps(1)) / np.float32(1000)
    np.testing.assert_allclose(dataset.read(1).depth_m, expected)


def test_where_stamps_stand_still_the_times_of_recording_count(make: Make) -> None:
    def content(bag: Bag) -> None:
        header, bag.latency = bag.header, 0.0
        bag.header = lambda at, frame: header(7.0 if frame == FRAME else at, frame)  # type: ignore[method-assign]
        plain(bag)

    dataset = open_dataset(make(content, kind="mcap"))
    assert f"the stamps of {TOPIC} do not change: the times of recording are used" in dataset.notes
    check_poses(dataset)


ROUNDED = 1e-6
"""Metres: a difference of stamps, in seconds since 1970, is rounded to a quarter of a microsecond."""


def unstamped(bag: Bag, which: Callable[[int], bool], send: Callable[..., None]) -> None:
    """Messages whose stamp is 0 where ``which`` says so of their number; all are recorded as late."""
    header, number = bag.header, iter(range(1000))

    def some(at: float, of: str) -> Any:
        if not which(next(number)):
            return header(at, of)
        zero = header(at, of)
        zero.stamp = bag.message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return zero

    bag.header = some  # type: ignore[method-assign]
    send(bag)
    bag.header = header  # type: ignore[method-assign]


def info(bag: Bag) -> None:
    bag.camera_info(INFO, FRAME, CAMERA)


def test_stamps_of_zero_are_the_times_of_recording_less_the_delay_of_the_poses(make: Make) -> None:
    images_alone = partial(images, info=False)
    dataset = open_dataset(
        make(info, partial(unstamped, which=lambda i: True, send=images_alone), odometry, mounted)
    )
    check_poses(dataset, atol=ROUNDED)
    assert (
        f"the stamps of {TOPIC} are 0: the times of recording are used, less the 0.050 s of /odom"
        in dataset.notes
    )


def test_stamps_of_zero_where_nothing_tells_the_delay_are_noted(make: Make) -> None:
    def all_unstamped(bag: Bag) -> None:
        unstamped(bag, lambda i: True, partial(images, info=False))
        unstamped(bag, lambda i: True, odometry)

    dataset = open_dataset(make(info, all_unstamped, mounted))
    check_poses(dataset, atol=ROUNDED)
    said = f"the stamps of {TOPIC} are 0: the times of recording are used, which are later"
    assert said in dataset.notes


@pytest.mark.parametrize("send", [partial(images, info=False), odometry, moving_tf])
def test_one_stamp_of_zero_is_the_time_of_recording_less_the_usual_delay(
    make: Make, send: Callable[..., None]
) -> None:
    others = odometry if isinstance(send, partial) else partial(images, info=False)
    dataset = open_dataset(
        make(info, partial(unstamped, which=lambda i: i == 2, send=send), others, mounted, kind="mcap")
    )
    check_poses(dataset, atol=ROUNDED)
    if isinstance(send, partial):
        assert any(f"1 of {COUNT} images of {TOPIC} have a stamp that is 0" in n for n in dataset.notes)
        assert any("less the usual 0.050 s" in note for note in dataset.notes)


def test_a_stamp_that_is_told_by_nothing_leaves_its_image_out(make: Make) -> None:
    """Delays grow by more than half the time between two images."""

    def slower(bag: Bag) -> None:
        for i in range(COUNT):
            bag.latency = 0.05 + 0.08 * i
            unstamped(bag, partial(eq, 2 - i), partial(images, info=False, numbers=[i]))
        bag.latency = 0.05

    dataset = open_dataset(make(info, slower, odometry, mounted, kind="mcap"))
    right = [START + stamp(i) for i in range(COUNT) if i != 2]
    np.testing.assert_allclose(dataset.stamps(), right, atol=ROUNDED)
    assert any(f"1 of {COUNT} images of {TOPIC} left out" in note for note in dataset.notes)


def test_a_stamp_that_is_repeated_is_mended_unless_the_image_is_too(make: Make) -> None:
    def again(bag: Bag, image: int) -> None:
        for i in range(COUNT):
            header = bag.header
            bag.header = lambda at, frame: header(stamp(1) if i == 2 else at, frame)  # type: ignore[method-assign]  # noqa: B023
            images(bag, info=False, numbers=[i], image=lambda i: steps(image if i == 2 else i))
            bag.header = header  # type: ignore[method-assign]

    other = open_dataset(make(info, partial(again, image=2), odometry, mounted, kind="mcap"))
    check_poses(other, atol=ROUNDED)
    same = open_dataset(make(info, partial(again, image=1), odometry, mounted, kind="mcap"))
    np.testing.assert_allclose(same.stamps()[2], START + stamp(1), atol=ROUNDED)


@given(
    st.lists(st.floats(0.01, 0.2), min_size=8, max_size=30),
    st.floats(0.0, 0.5),
    st.integers(0, 10**6),
)
def test_stamps_that_are_right_stay_and_wrong_ones_are_found(
    gaps: list[float], delay: float, seed: int
) -> None:
    stamps = 1e9 + np.cumsum(gaps)
    found, wrong = mended_stamps(stamps + delay, stamps)
    assert not wrong.any()
    np.testing.assert_array_equal(found, stamps)
    bad = np.random.default_rng(seed).permutation(len(stamps))[: len(stamps) // 4]
    given_ = stamps.copy()
    given_[bad] = 0
    found, wrong = mended_stamps(stamps + delay, given_)
    np.testing.assert_array_equal(np.flatnonzero(wrong), np.sort(bad))
    np.testing.assert_allclose(found, stamps, atol=1e-6)


@pytest.mark.parametrize("poses", [odometry, moving_tf])
def test_late_poses_are_interpolated_in_their_own_times(make: Make, poses: Callable[..., None]) -> None:
    """The body goes a path that bends between two images; its poses are stamped .05 s late."""

    def dense(bag: Bag) -> None:
        poses(bag, late=0.05, numbers=np.arange(-1, COUNT, 0.1).tolist())

    dataset = open_dataset(make(images, dense, mounted, kind="mcap"), poses_are="late=0.05")
    check_poses(dataset, atol=ROUNDED)
    assert not any("only the poses of frames" in note for note in dataset.notes)


def test_a_transform_that_is_sent_once_holds_where_another_moves(make: Make) -> None:
    def once(bag: Bag) -> None:
        bag.tf("/tf", stamp(2), "map", "odom", np.eye(4))
        moving_tf(bag)

    check_poses(open_dataset(make(images, mounted, once)))
    mounted_once = make(images, once, lambda bag: bag.tf("/tf", stamp(1), BODY, FRAME, T_body_camera))
    check_poses(open_dataset(mounted_once))


@pytest.mark.parametrize("source", ["tf", "odometry", "pose"])
@pytest.mark.parametrize("is_body", [True, False])
def test_poses_of_a_camera_link_are_turned_if_images_agree_so(make: Make, source: str, is_body: bool) -> None:
    frame = FRAME if source == "pose" else "camera_link"

    def poses(bag: Bag) -> None:
        send: dict[str, Callable[[float, Pose], object]] = {
            "tf": lambda at, T: bag.tf("/tf", at, "odom", frame, T),
            "odometry": lambda at, T: bag.odometry("/odom", at, "odom", frame, T),
            "pose": lambda at, T: bag.pose_stamped("/camera/pose", at, "odom", T),
        }
        for i, T in enumerate(EYES):
            send[source](stamp(i), T @ T_LINK_CAMERA.T if is_body else T)

    dataset = open_dataset(make(partial(images, frame=frame, image=seen), poses, kind="mcap"))
    for frame_read, T in zip(dataset, EYES, strict=True):
        np.testing.assert_allclose(frame_read.T_world_camera, T, atol=1e-6)
    assert any("of a body, x ahead and z up" in note for note in dataset.notes) == is_body


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
@pytest.mark.parametrize(
    "names",
    [("walk_0", "walk_1"), ("2026-11-25-10-00-00_0", "2026-11-25-10-00-03_1"), ("walk_3", "walk_4")],
    ids=["numbers", "times", "the first files are gone"],
)
def test_the_files_of_a_split_recording_are_read_together(
    make: Make, tmp_path: Path, kind: Kind, names: tuple[str, str]
) -> None:
    """The mounting is in the first file only."""
    folder = tmp_path / "rec"
    folder.mkdir()
    for name, half in zip(names, (range(COUNT // 2), range(COUNT // 2, COUNT)), strict=True):
        informed = partial(Bag.camera_info, topic=INFO, frame=FRAME, camera=CAMERA, stamp=stamp(half[0]))
        parts = [informed, partial(images, info=False, numbers=half), partial(odometry, numbers=half)]
        first = [mounted] if half[0] == 0 else []
        data = data_file(make(*first, *parts, kind=kind, name=name))
        data.rename(folder / (name + data.suffix))
    dataset = open_dataset(folder)
    suffix = data.suffix
    assert f"{names[0]}{suffix} to {names[1]}{suffix}: 2 files are read as one recording" in dataset.notes
    check_poses(dataset)
    for i in range(COUNT):
        np.testing.assert_allclose(dataset.read(i).depth_m, steps(i) / 1000, rtol=1e-6)


def test_numbered_bags_that_do_not_follow_each_other_are_several(tmp_path: Path) -> None:
    for number, later in enumerate((0.0, 60.0)):
        with writing(tmp_path / f"run_{number}.bag", "ros1") as bag:
            bag.image(TOPIC, later, FRAME, steps(0), "16UC1")
    said = "contains several recordings (run_1.bag begins 60.0 s after the end of the one before)"
    refused(tmp_path, said, "pass one of: run_0.bag, run_1.bag")


def test_a_folder_of_bags_names_them(make: Make, tmp_path: Path) -> None:
    make(plain)
    make(plain, kind="mcap", name="second")
    assert refused(tmp_path).endswith("pass one of: second, walk.bag")


def test_an_identity_for_a_calibration_gives_way_to_the_projection() -> None:
    P = np.array([[62.0, 0, 39.5, 0], [0, 62, 29.5, 0], [0, 0, 1, 0]])
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    info = SimpleNamespace(
        k=np.eye(3).ravel(), d=np.zeros(5), p=P.ravel(), width=80, height=60, roi=roi,
        binning_x=0, binning_y=0, distortion_model="plumb_bob",
    )  # fmt: skip
    camera, distortion = camera_of(info, rectified=False)
    assert (camera.full, distortion) == (PinholeCamera(80, 60, 62, 62, 39.5, 29.5), ())
    info.p = np.zeros(12)
    with pytest.raises(DatasetError, match=r"not calibrated .a focal length of 1 pixels.; pass --camera"):
        camera_of(info, rectified=False)
