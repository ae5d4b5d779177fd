"""Images of confidence in bags: grades of 4 bits as a sigma for each pixel, and those that cannot be used."""

from functools import partial

import numpy as np
import pytest
from inputs_bags import CAMERA, COUNT, FRAME, Bag, Kind, Make, plain, stamp, steps
from refusals import bad_frame, refused

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.confidence import L515
from taichi_mrf.datasets.recorded_noise import with_recorded_noise

TOPIC = "/camera/confidence/image_rect_raw"


def grades(i: int) -> np.ndarray:
    image = np.random.default_rng(200 + i).integers(0, 16, CAMERA.shape).astype(np.uint8)
    image[0, :3] = 0, 1, 15
    return image


def confidence(
    bag: Bag, topic: str = TOPIC, shift: int = 4, encoding: str = "mono8", skip: int | None = None
) -> None:
    for i in range(COUNT):
        if i != skip:
            bag.image(topic, stamp(i) + 0.01, FRAME, grades(i) << shift, encoding)


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
    assert f"confidence: {TOPIC}, as a sigma for each pixel" in dataset.notes


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
    dataset = open_dataset(make(plain, lambda bag: confidence(bag, skip=3)), color=False)
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
    path = make(plain, lambda bag: bag.image(TOPIC, 1.0, FRAME, image, encoding))
    dataset = open_dataset(f"{path}?depth=/camera/depth/image_raw", color=False)
    assert not dataset.stated.pixel_sigma
    (note,) = [note for note in dataset.notes if note.startswith("confidence: ")]
    assert f"{TOPIC} is not used: " in note
    assert problem in note
    source = f"{path}?depth=/camera/depth/image_raw&confidence={TOPIC}"
    refused(source, f"{path}: topic {TOPIC}: ", problem)


def test_a_topic_of_another_name_can_be_named(make: Make) -> None:
    path = make(plain, lambda bag: confidence(bag, "/trust"))
    dataset = open_dataset(f"{path}?confidence=/trust", color=False)
    np.testing.assert_allclose(dataset.read(1).sigma_m, expected(1), rtol=1e-6)
    refused(f"{path}?confidence=/odom", "is of type nav_msgs/msg/Odometry, not")
    refused(f"{path}?confidence=/nothing", "there is no topic /nothing; topics of confidence: none")


def test_of_two_topics_one_must_be_chosen(make: Make) -> None:
    other = "/camera/confidence/image_raw"
    dataset = open_dataset(make(plain, confidence, lambda bag: confidence(bag, other)), color=False)
    assert dataset.read(0).sigma_m is None
    assert f"confidence: choose one with ?confidence={other} or ?confidence={TOPIC}" in dataset.notes


def test_a_later_image_that_is_damaged_is_a_bad_frame(make: Make) -> None:
    def write(bag: Bag) -> None:
        bag.image(TOPIC, stamp(0), FRAME, grades(0), "mono8")
        bag.image(TOPIC, stamp(1), FRAME, np.full(CAMERA.shape, 200, np.uint8), "mono8")
        bag.image(TOPIC, stamp(2), FRAME, grades(2)[1:], "mono8")

    dataset = open_dataset(make(plain, write), color=False)
    assert dataset.read(0).sigma_m is not None
    bad_frame(dataset, 1, f"topic {TOPIC}: has values up to 200, which are no")
    bad_frame(dataset, 2, "has 16 x 11 pixels", "expected 16 x 12")
