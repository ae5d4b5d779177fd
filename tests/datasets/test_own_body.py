"""--mask and --body-box: what the robot's own body covers is no measurement."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import Content, arrays, write_image, write_npz, write_seven_scenes, write_tum
from inputs_frames import of_frames
from point_clouds import Walk, write_scans
from refusals import bad_frame, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.own_body import NO_BODY, OwnBody
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.without_body import masked
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

BODY = np.zeros((12, 16), bool)
BODY[7:, 3:9] = True
BOX = (-0.5, -2.0, 0.0, 1.5, 0.75, 4.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A 7-Scenes recording of 16 x 12 pixels."""
    return write_seven_scenes(tmp_path / "office", Content())


def mask(path: Path, body: np.ndarray = BODY) -> str:
    return str(write_image(path, np.where(body, 0, 255).astype(np.uint8)))


def test_masked_pixels_are_no_measurements(folder: Path, tmp_path: Path) -> None:
    plain, seen = open_dataset(folder), open_dataset(folder, body=OwnBody(mask=mask(tmp_path / "m.png")))
    for before, after in zip(plain, seen, strict=True):
        np.testing.assert_array_equal(after.depth_m, np.where(BODY, 0, before.depth_m))
        assert after.depth_m.dtype == np.float32
        assert (after.name, after.stamp, after.camera) == (before.name, before.stamp, before.camera)
    assert f"mask: {tmp_path / 'm.png'} covers {BODY.mean():.1%} of the pixels" in seen.notes


def test_anything_but_0_is_the_world(folder: Path, tmp_path: Path) -> None:
    """Also in images of 16 bits."""
    levels = np.where(BODY, 0, np.arange(1, 193).reshape(12, 16) * 300).astype(np.uint16)
    path = write_image(tmp_path / "m.png", levels)
    seen, plain = open_dataset(folder, body=OwnBody(mask=str(path))).read(1), open_dataset(folder).read(1)
    np.testing.assert_array_equal(seen.depth_m, np.where(BODY, 0, plain.depth_m))


@pytest.mark.parametrize(
    "reading",
    [
        {"image_scale": 0.5},
        {"undistort": (-0.25, 0.08, 0.0, 0.0)},
        {"depth_is": "range"},
        {"image_scale": 1 / 3},
    ],
)
def test_a_mask_is_of_images_as_they_are_stored(folder: Path, tmp_path: Path, reading: dict) -> None:
    """What undoes lens and size then works on images without these pixels."""
    content = Content()
    for image in content.depth:
        image[BODY] = 0
    holes = open_dataset(write_seven_scenes(tmp_path / "holes", content), **reading)
    seen = open_dataset(folder, body=OwnBody(mask=mask(tmp_path / "m.png")), **reading)
    for expected, frame in zip(holes, seen, strict=True):
        np.testing.assert_array_equal(frame.depth_m, expected.depth_m)


@pytest.mark.parametrize("turned", ["turned-left", "upside-down", "turned-right,mirrored"])
def test_a_mask_is_of_turned_images_as_they_are_stored(folder: Path, tmp_path: Path, turned: str) -> None:
    content = Content()
    for image in content.depth:
        image[BODY] = 0
    holes = open_dataset(write_seven_scenes(tmp_path / "holes", content), image_is=turned)
    seen = open_dataset(folder, body=OwnBody(mask=mask(tmp_path / "m.png")), image_is=turned)
    np.testing.assert_array_equal(seen.read(2).depth_m, holes.read(2).depth_m)


def test_masked_pixels_are_never_without_a_return(tmp_path: Path) -> None:
    depth_m = np.arange(192, dtype=np.float32).reshape(12, 16) % 3
    camera = PinholeCamera(16, 12, 14.0, 15.0, 7.5, 5.5)
    frame = Frame(depth_m, np.eye(4), camera, 0.0, "only", no_return=depth_m == 0)
    seen = masked(of_frames([frame]), mask(tmp_path / "m.png")).read(0)
    assert seen.no_return is not None
    np.testing.assert_array_equal(seen.no_return, (depth_m == 0) & ~BODY)
    assert not seen.depth_m[BODY].any()


def test_masks_that_do_not_fit(folder: Path, tmp_path: Path) -> None:
    def said(file: str, *words: str) -> None:
        refused(folder, file, *words, body=OwnBody(mask=file))

    said(str(tmp_path / "gone.png"), "the mask is missing")
    said(mask(tmp_path / "wide.png", BODY.T), "12 x 16 pixels", "office 16 x 12", "as it is stored")
    said(mask(tmp_path / "all.png", np.ones_like(BODY)), "covers all pixels; 0 is the body")
    colors = write_image(tmp_path / "rgb.png", np.zeros((12, 16, 3), np.uint8))
    said(str(colors), "has 3 channels; it needs one, 0 for the body")
    (tmp_path / "text.png").write_text("a mask")
    said(str(tmp_path / "text.png"), "not a readable image")
    write_scans(tmp_path / "scans", Walk())
    refused(tmp_path / "scans", "--mask", "--body-box", body=OwnBody(mask=mask(tmp_path / "m.png")))


def test_a_frame_of_another_size_than_the_mask_is_named(folder: Path, tmp_path: Path) -> None:
    write_image(folder / "frame-000010.depth.png", np.ones((10, 16), np.uint16))
    dataset = open_dataset(folder, body=OwnBody(mask=mask(tmp_path / "m.png")))
    bad_frame(dataset, 1, "16 x 10 pixels")


@pytest.mark.parametrize(
    "reading", [{}, {"depth_is": "range"}, {"image_scale": 0.5}, {"poses_are": "opengl"}]
)
def test_what_ends_in_a_box_of_the_sensors_frame_is_dropped(folder: Path, reading: dict) -> None:
    near = (-9.0, -9.0, 0.0, 9.0, 9.0, 1.0)
    dropped = 0
    plain, seen = (
        open_dataset(folder, **reading),
        open_dataset(folder, body=OwnBody(body_box=(BOX, near)), **reading),
    )
    for before, after in zip(plain, seen, strict=True):
        x, y, z = np.moveaxis(before.points_m, -1, 0)
        inside = (x >= -0.5) & (x <= 1.5) & (y >= -2) & (y <= 0.75) & (z <= 4) | (z <= 1)
        np.testing.assert_array_equal(after.depth_m, np.where(inside, 0, before.depth_m))
        dropped += int((inside & (before.depth_m > 0)).sum())
    assert dropped > 50
    assert "own body: measurements are left out in 2 boxes" in seen.notes


def test_a_box_is_of_images_that_are_put_back(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", Content())
    reading = {"image_is": "upside-down"}
    plain, seen = (
        open_dataset(folder, **reading).read(1),
        open_dataset(folder, body=OwnBody(body_box=(BOX,)), **reading),
    )
    p = plain.points_m
    inside = ((p >= BOX[:3]) & (p <= BOX[3:])).all(axis=-1)
    assert inside.any()
    np.testing.assert_array_equal(seen.read(1).depth_m, np.where(inside, 0, plain.depth_m))


def test_a_box_works_for_lidars(tmp_path: Path) -> None:
    source = write_scans(tmp_path / "scans", Walk())
    plain, seen = open_dataset(source), open_dataset(source, body=OwnBody(body_box=((-2, -2, -3, 2, 3, 2),)))
    for before, after in zip(plain, seen, strict=True):
        p = before.points_m
        inside = ((p >= [-2, -2, -3]) & (p <= [2, 3, 2])).all(axis=-1) & (before.depth_m > 0)
        assert inside.any()
        np.testing.assert_array_equal(after.depth_m, np.where(inside, 0, before.depth_m))


@pytest.mark.parametrize(
    "box",
    [(0, 0, 0, 0, 1, 1), (1, 0, 0, -1, 1, 1), (0, 0, float("nan"), 1, 1, 1), (0, 0, 0, 1, 1, float("inf"))],
)
def test_boxes_that_are_none(box: tuple) -> None:
    with pytest.raises(ConfigError, match="--body-box takes X0 Y0 Z0 X1 Y1 Z1 in metres"):
        OwnBody(body_box=(box,))
    with pytest.raises(ConfigError, match="--body-box takes"):
        SourceFlags(body_box=(box,))


def test_flags_become_options_and_words() -> None:
    flags = SourceFlags(mask="a b.png", body_box=(BOX, BOX), depth_scale=5.0)
    assert flags.keywords()["body"] == OwnBody(mask="a b.png", body_box=(BOX, BOX))
    box = ["--body-box", "-0.5", "-2.0", "0.0", "1.5", "0.75", "4.0"]
    assert flags.words() == ["--mask=a b.png", "--depth-scale=5.0", *box, *box]
    assert SourceFlags().keywords()["body"] == NO_BODY
    assert flags.within(Path("/data")).mask == "/data/a b.png"
    assert flags.within(Path("/data")) == replace(flags, mask="/data/a b.png")


def test_each_of_several_sensors_has_its_own(tmp_path: Path) -> None:
    """The mask's path is relative to the file that lists the sensors."""
    content = Content()
    write_npz(tmp_path / "depth.npz", arrays(content) | {"stamp": 5.5 + 0.2 * np.arange(content.count)})
    write_scans(tmp_path / "scans", Walk())
    mask(tmp_path / "arm.png")
    text = (
        "sensors:\n"
        "- {name: depth, source: depth.npz, reading: {mask: arm.png}}\n"
        "- {name: lidar, source: scans, reading: {body_box: [[-2, -2, -3, 2, 3, 2]]}}\n"
    )
    (tmp_path / "robot.yaml").write_text(text)
    dataset = open_dataset(tmp_path / "robot.yaml")
    for frame in dataset:
        p = frame.points_m
        if frame.sensor == "depth":
            assert not frame.depth_m[BODY].any()
        else:
            assert not (((p >= [-2, -2, -3]) & (p <= [2, 3, 2])).all(axis=-1) & (frame.depth_m > 0)).any()
    assert any(note.startswith("depth: mask: ") for note in dataset.notes)
    refused(tmp_path / "robot.yaml", "set how each is read there", body=OwnBody(mask="arm.png"))
    (tmp_path / "robot.yaml").write_text(text.replace(", 3, 2]]", ", 3]]"))
    refused(tmp_path / "robot.yaml", "body_box must have 6 entries, not 5")
