"""Colour topics of bags: registered to depth, of a camera of their own, and those that cannot be used."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from inputs_bags import CAMERA, COUNT, FRAME, Bag, Make, images, mounted, plain, stamp, steps
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.color_camera import ColorCamera
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import PinholeCamera

TOPIC, OWN_FRAME = "/camera/color/image_raw", "camera_color_optical_frame"
OWN = PinholeCamera(24, 18, 21.0, 22.0, 11.5, 8.5)
T_depth_color = np.eye(4)
T_depth_color[0, 3] = 0.025


def picture(i: int, camera: PinholeCamera = CAMERA) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(1, 256, (*camera.shape, 3)).astype(np.uint8)


def registered(bag: Bag, encoding: str = "rgb8") -> None:
    def image(i: int) -> np.ndarray:
        rgb = picture(i)
        return rgb if encoding == "rgb8" else np.dstack([rgb[..., ::-1], rgb[..., :1]])

    images(bag, TOPIC, info=False, image=image, encoding=encoding, late=0.01)


def compressed(bag: Bag) -> None:
    for i in range(COUNT):
        bag.compressed(TOPIC, stamp(i), FRAME, picture(i), "png")


def beside(bag: Bag, info: bool = True, tf: bool = True) -> None:
    if info:
        bag.camera_info("/camera/color/camera_info", OWN_FRAME, OWN)
    if tf:
        mounted(bag, FRAME, OWN_FRAME, T_depth_color)
    images(bag, TOPIC, False, OWN_FRAME, lambda i: picture(i, OWN), "rgb8")


def left(bag: Bag) -> None:
    """A second topic, of one image."""
    bag.image("/left", 1.0, FRAME, picture(7), "bgr8")


@pytest.mark.parametrize("write", [registered, lambda bag: registered(bag, "bgra8"), compressed])
def test_registered_colours_come_back(make: Make, write: Callable[[Bag], None]) -> None:
    dataset = open_dataset(make(plain, write, kind="mcap"))
    for i in (2, 0, 4):
        np.testing.assert_array_equal(dataset.read(i).color, picture(i))
    assert any(note == f"color: {TOPIC}, registered to depth" for note in dataset.notes)


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
