"""Topics beside depth in bags: colours, images of confidence and IMUs, and those that cannot be used."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import pytest
from inputs_bags import (
    CAMERA,
    CONFIDENCE,
    COUNT,
    FRAME,
    IMU,
    LINK,
    RATE,
    UP,
    Bag,
    Kind,
    Make,
    T_camera_imu,
    confidence,
    grades,
    images,
    imu,
    mounted,
    plain,
    stamp,
    steps,
)  # fmt: skip
from refusals import bad_frame, refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.base import start_pose
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.motion import GRAVITY, upwards

COLOR, OWN_FRAME = "/camera/color/image_raw", "camera_color_optical_frame"
OWN = PinholeCamera(24, 18, 21.0, 22.0, 11.5, 8.5)
T_depth_color = np.eye(4)
T_depth_color[0, 3] = 0.025


def picture(i: int, camera: PinholeCamera = CAMERA) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(1, 256, (*camera.shape, 3)).astype(np.uint8)


def registered(bag: Bag, encoding: str = "rgb8") -> None:
    def image(i: int) -> np.ndarray:
        rgb = picture(i)
        return rgb if encoding == "rgb8" else np.dstack([rgb[..., ::-1], rgb[..., :1]])

    images(bag, COLOR, info=False, image=image, encoding=encoding, late=0.01)


def compressed(bag: Bag) -> None:
    for i in range(COUNT):
        bag.compressed(COLOR, stamp(i), FRAME, picture(i), "png")


def beside(bag: Bag, info: bool = True, tf: bool = True) -> None:
    if info:
        bag.camera_info("/camera/color/camera_info", OWN_FRAME, OWN)
    if tf:
        mounted(bag, FRAME, OWN_FRAME, T_depth_color)
    images(bag, COLOR, False, OWN_FRAME, lambda i: picture(i, OWN), "rgb8")


def left(bag: Bag) -> None:
    """A second topic, of one image."""
    bag.image("/left", 1.0, FRAME, picture(7), "bgr8")


@pytest.mark.parametrize("write", [registered, lambda bag: registered(bag, "bgra8"), compressed])
def test_registered_colours_come_back(make: Make, write: Callable[[Bag], None]) -> None:
    dataset = open_dataset(make(plain, write, kind="mcap"))
    for i in (2, 0, 4):
        np.testing.assert_array_equal(dataset.read(i).color, picture(i))
    assert any(note == f"color: {COLOR}, registered to depth" for note in dataset.notes)


def test_a_camera_of_its_own_is_brought_to_the_depth_pixels(make: Make) -> None:
    dataset = open_dataset(make(plain, beside))
    own = ColorCamera(OWN, inverse(T_depth_color))
    for i in range(COUNT):
        frame = dataset.read(i)
        np.testing.assert_array_equal(frame.color, own.registered(picture(i, OWN), frame.depth_m, CAMERA))
        assert frame.color.any()
        assert not frame.color[steps(i) == 0].any()


@pytest.mark.parametrize(
    ("parts", "problem"),
    [
        ([partial(beside, tf=False)], "tf has no fixed transform"),
        ([partial(beside, info=False)], "its CameraInfo is not known"),
        ([registered, left], "choose one with"),
    ],
)
def test_colours_that_cannot_be_used_are_named(make: Make, parts: list, problem: str) -> None:
    dataset = open_dataset(make(plain, *parts))
    assert dataset.read(0).color is None
    (note,) = [note for note in dataset.notes if note.startswith("color: ")]
    assert problem in note


def test_a_colour_topic_can_be_chosen_and_must_be_one(make: Make) -> None:
    path = make(plain, registered, left)
    dataset = open_dataset(f"{path}?color=/left")
    np.testing.assert_array_equal(dataset.read(0).color, picture(7)[..., ::-1])
    assert dataset.read(1).color is None
    assert any("4 of 5 images have none" in note for note in dataset.notes)
    refused(f"{path}?color=/camera/depth/image_raw&depth=/camera/depth/image_raw", "is not colour")


def expected(i: int) -> np.ndarray:
    """sigma / max(share, 0.1), infinite for the grade 0."""
    depth_m = np.where(steps(i) > 0, steps(i) / 1000, 0.0)
    sigma = L515.sigma[0] + L515.sigma[1] * depth_m
    return np.where(grades(i) > 0, sigma / np.maximum(grades(i) / 15, 0.1), np.inf)


@pytest.mark.parametrize(("kind", "shift", "encoding"), [("mcap", 4, "mono8"), ("ros1", 0, "8UC1")])
def test_grades_are_a_sigma(make: Make, kind: Kind, shift: int, encoding: str) -> None:
    graded = partial(confidence, shift=shift, encoding=encoding)
    dataset = open_dataset(make(plain, graded, kind=kind), color=False)
    for i in (2, 0, 4):
        np.testing.assert_allclose(dataset.read(i).sigma_m, expected(i), rtol=1e-6)
    assert with_recorded_noise(Config(), dataset).sensor == SensorConfig(sigma=L515.sigma)
    assert f"confidence: {CONFIDENCE}, as a sigma for each pixel" in dataset.notes


def test_a_bag_without_confidence_states_no_sigma(make: Make) -> None:
    elsewhere = partial(confidence, topic="/other/confidence/image_rect_raw")
    dataset = open_dataset(make(plain, elsewhere), color=False)
    assert dataset.read(0).sigma_m is None
    assert not dataset.stated.pixel_sigma
    assert dataset.stated.sigma is None
    assert not any(note.startswith("confidence") for note in dataset.notes)


def test_the_sigma_of_the_l515_is_the_makers_error_and_noise_together() -> None:
    for depth_m, error_mm, noise_mm in ((1.0, 5.0, 2.5), (9.0, 14.0, 15.5)):
        stated_m = L515.sigma[0] + L515.sigma[1] * depth_m
        assert stated_m == pytest.approx(np.hypot(error_mm, noise_mm) / 1000, abs=1e-4)


def test_an_image_without_confidence_has_the_same_sigma_everywhere(make: Make) -> None:
    path = make(plain, partial(confidence, skip=3))
    dataset = open_dataset(path, color=False)
    assert dataset.read(3).sigma_m is None
    assert dataset.read(4).sigma_m is not None
    assert any(note.endswith("; 1 of 5 images have none") for note in dataset.notes)


WRONG = [
    (grades(0)[::2, ::2], "mono8", "its images have 8 x 6 pixels, those of depth 16 x 12"),
    (grades(0).astype(np.uint16), "mono16", "'mono16' is not grey of 8 bits"),
]


@pytest.mark.parametrize(("image", "encoding", "problem"), WRONG)
def test_confidence_that_does_not_fit_is_named(
    make: Make, image: np.ndarray, encoding: str, problem: str
) -> None:
    path = make(plain, lambda bag: bag.image(CONFIDENCE, 1.0, FRAME, image, encoding))
    dataset = open_dataset(f"{path}?depth=/camera/depth/image_raw", color=False)
    assert not dataset.stated.pixel_sigma
    (note,) = [note for note in dataset.notes if note.startswith("confidence: ")]
    assert f"{CONFIDENCE} is not used: " in note
    assert problem in note
    source = f"{path}?depth=/camera/depth/image_raw&confidence={CONFIDENCE}"
    refused(source, f"{path}: topic {CONFIDENCE}: ", problem)


def test_a_topic_of_another_name_can_be_named_and_of_two_one_must_be(make: Make) -> None:
    path = make(plain, partial(confidence, topic="/trust"))
    dataset = open_dataset(f"{path}?confidence=/trust", color=False)
    np.testing.assert_allclose(dataset.read(1).sigma_m, expected(1), rtol=1e-6)
    refused(f"{path}?confidence=/odom", "is of type nav_msgs/msg/Odometry, not")
    refused(f"{path}?confidence=/nothing", "there is no topic /nothing; topics of confidence: none")
    other = "/camera/confidence/image_raw"
    two = open_dataset(make(plain, confidence, partial(confidence, topic=other)), color=False)
    assert two.read(0).sigma_m is None
    assert f"confidence: choose one with ?confidence={other} or ?confidence={CONFIDENCE}" in two.notes


def test_a_later_image_that_is_damaged_is_a_bad_frame(make: Make) -> None:
    def write(bag: Bag) -> None:
        bag.image(CONFIDENCE, stamp(0), FRAME, grades(0), "mono8")
        bag.image(CONFIDENCE, stamp(1), FRAME, np.full(CAMERA.shape, 200, np.uint8), "mono8")
        bag.image(CONFIDENCE, stamp(2), FRAME, grades(2)[1:], "mono8")

    dataset = open_dataset(make(plain, write), color=False)
    assert dataset.read(0).sigma_m is not None
    bad_frame(dataset, 1, f"topic {CONFIDENCE}: has values up to 200, which are no")
    bad_frame(dataset, 2, "has 16 x 11 pixels", "expected 16 x 12")


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_turns_come_in_the_cameras_frame_and_the_first_image_is_level(make: Make, kind: Kind) -> None:
    dataset = open_dataset(f"{make(images, imu, kind=kind)}?poses=track")
    first, second = dataset.read(0), dataset.read(1)
    R = second.gyro.turn(first.stamp, second.stamp)
    np.testing.assert_allclose(R, cv2.Rodrigues(RATE * (stamp(1) - stamp(0)))[0], atol=1e-6)
    np.testing.assert_allclose(first.T_world_camera[:3, :3] @ UP, [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(second.acceleration.accelerations_m_s2[7], GRAVITY * UP, atol=1e-4)
    np.testing.assert_array_equal(second.acceleration.position_m, T_camera_imu[:3, 3])
    assert any(f"{IMU} measures turns; the first image is level" in note for note in dataset.notes)


def test_what_shakes_does_not_say_which_way_is_up(make: Make) -> None:
    dataset = open_dataset(f"{make(images, lambda bag: imu(bag, shake=2.0))}?poses=track")
    np.testing.assert_array_equal(dataset.read(0).T_world_camera, start_pose())
    assert any("it does not say which way is up" in note for note in dataset.notes)
    assert upwards(np.tile([0.0, 0.0, 12.0], (20, 1))) is None
    assert upwards(np.tile([0.0, 0.0, GRAVITY], (5, 1))) is None
    np.testing.assert_allclose(upwards(np.tile([0.0, -GRAVITY, 0.0], (20, 1))), [0, -1, 0])


def test_topics_that_cannot_be_used_are_named(make: Make) -> None:
    dataset = open_dataset(f"{make(images, lambda bag: imu(bag, tf=False))}?poses=track")
    assert dataset.read(0).gyro is None
    assert any(f"no fixed transform from {LINK!r} to {FRAME!r}" in note for note in dataset.notes)
    both = make(images, imu, lambda bag: imu(bag, topic="/other"), kind="mcap")
    dataset = open_dataset(f"{both}?poses=track")
    assert any("choose one with ?imu=" in note for note in dataset.notes)
    assert open_dataset(f"{both}?poses=track&imu=/other").read(0).gyro is not None
    assert open_dataset(f"{both}?poses=track&imu=none").notes == []


def test_accelerations_alone_are_no_turns(make: Make) -> None:
    path = make(images, lambda bag: imu(bag, covariance=-1.0))
    assert open_dataset(f"{path}?poses=track").read(0).gyro is None
    refused(f"{path}?poses=track&imu={IMU}", f"topic {IMU} has no angular rates")


@pytest.mark.parametrize("up", [(0, -1, 0), (0.1, -0.9, 0.3), (0.0, 0.0, -1.0), (0.05, 0.02, 1.0), (1, 0, 0)])
def test_a_start_pose_is_level_and_looks_along_x(up: tuple) -> None:
    unit = np.array(up) / np.linalg.norm(up)
    R = start_pose(unit)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R @ unit, [0, 0, 1], atol=1e-12)
    ahead = R @ [0, 0, 1]
    assert ahead[1] == pytest.approx(0, abs=0.06)
    if up == (0, -1, 0):
        np.testing.assert_allclose(start_pose(unit), start_pose(), atol=1e-12)
