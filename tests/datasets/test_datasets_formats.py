"""Recordings written in every folder format are recognised and come back as they were written; views of the
real ones agree with each other."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    CAMERA,
    CAMERA_TXT,
    FORMATS,
    Content,
    check_frames,
    stamped_line,
    write_freiburg,
    write_house,
    write_image,
    write_log,
    write_numbered,
    write_redwood,
    write_rows,
    write_seven_scenes,
    write_tum,
)
from every_format import WHOLE_NUMBERS
from refusals import refused
from rtabmap_database import rvl

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.formats.numbered_depth import ICL_NUIM
from taichi_mrf.datasets.formats.rtabmap import decode_depth
from taichi_mrf.datasets.options import PRIMESENSE
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame


@pytest.mark.parametrize("name", FORMATS)
def test_round_trip(tmp_path: Path, name: str) -> None:
    written, content = FORMATS[name], Content()
    dataset = open_dataset(written.write(tmp_path / "recording", content))
    assert dataset.name == "recording"
    assert dataset.dropped == 0
    check_frames(dataset, content, written.steps, written.colored)
    stamps = [written.first_s + i * written.step_s for i in range(content.count)]
    np.testing.assert_allclose([frame.stamp for frame in dataset], stamps, atol=1e-6)


@pytest.mark.parametrize("name", FORMATS)
def test_the_callers_word_wins(tmp_path: Path, name: str) -> None:
    content = Content(3)
    camera = PinholeCamera(16, 12, 20.0, 20.0, 8.0, 6.0)
    folder = FORMATS[name].write(tmp_path / "recording", content)
    dataset = open_dataset(folder, camera=camera, depth_scale=2000.0, color=False)
    check_frames(dataset, content, 2000.0, camera=camera)


@pytest.mark.parametrize(
    ("name", "folder", "expected"),
    [
        ("seven_scenes", "chess", PinholeCamera(640, 480, 585, 585, 320, 240)),
        ("tum", "rgbd_dataset_freiburg1_desk", PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3)),
        ("tum", "rgbd_dataset_freiburg3_office", PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6)),
        ("tum", "mine", PinholeCamera(640, 480, 525, 525, 319.5, 239.5)),
        ("redwood", "livingroom1", PinholeCamera(640, 480, 525, 525, 319.5, 239.5)),
        ("icl", "traj2", PinholeCamera(640, 480, 481.2, 480, 319.5, 239.5)),
        ("house", "house", PinholeCamera(640, 480, 525, 525, 319.5, 239.5)),
        ("house", "icl_nuim_traj2", PinholeCamera(640, 480, 481.2, 480, 319.5, 239.5)),
    ],
)
def test_an_assumed_camera_is_noted(tmp_path: Path, name: str, folder: str, expected: PinholeCamera) -> None:
    path = FORMATS[name].write(tmp_path / folder, Content(2, (480, 640)))
    (path / "camera.txt").unlink()
    dataset = open_dataset(path)
    assert dataset.camera == expected
    assert any("assumed" in note and f"fx {expected.fx:g}" in note for note in dataset.notes)


def test_images_of_another_size_than_the_assumed_camera(tmp_path: Path) -> None:
    folder = write_house(tmp_path / "recording", Content(2))
    (folder / "camera.txt").unlink()
    refused(folder, "16 x 12 pixels,", "Redwood has 640 x 480,", "--camera fx,fy,cx,cy")
    assert open_dataset(folder, intrinsics=(14, 15, 7.5, 5.5)).camera == CAMERA


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("camera.txt", f"# width height fx fy cx cy\n{CAMERA_TXT}\n", CAMERA),
        ("camera.yaml", "{width: 16, height: 12, fx: 14, fy: 15.0, cx: 7.5, cy: 5.5}", CAMERA),
        ("camera-intrinsics.txt", "14 0 7.5\n0 15 5.5\n0 0 1", CAMERA),
        ("intrinsics.txt", "1.4e1 0 7.5\n0 15 5.5\n0 0 1", CAMERA),
        ("K.txt", "[14, 0, 7.5]\n[0, 15, 5.5]\n[0, 0, 1]", CAMERA),
        ("cam_K.txt", "14 0 7.5 0\n0 15 5.5 0\n0 0 1 0", CAMERA),
        ("intrinsic.txt", "14 15 7.5 5.5", CAMERA),
        ("camera_intrinsics.txt", "fx: 14\nfy: 15\ncx = 7.5\ncy = 5.5", CAMERA),
        ("../camera-intrinsics.txt", "14 0 7.5\n0 15 5.5\n0 0 1", CAMERA),
    ],
)
def test_camera_files(tmp_path: Path, file: str, text: str, expected: PinholeCamera) -> None:
    folder = write_house(tmp_path / "recording", Content(2))
    (folder / "camera.txt").unlink()
    (folder / file).write_text(text)
    dataset = open_dataset(folder)
    assert dataset.camera == expected
    assert not any("assumed the camera" in note for note in dataset.notes)
    assert dataset.read(1).depth_m.shape == (12, 16)


@pytest.mark.parametrize("name", WHOLE_NUMBERS)
def test_the_largest_number_is_no_measurement_in_any_format(tmp_path: Path, name: str) -> None:
    content = Content(2)
    for image in content.depth:
        image[3, 4:7] = 65535, 65534, 65535
    for frame in open_dataset(WHOLE_NUMBERS[name](tmp_path / "recording", content)):
        assert frame.depth_m[3, 5] > 6
        assert np.flatnonzero(frame.depth_m == 0).tolist() == [0, 3 * 16 + 4, 3 * 16 + 6]


def test_the_largest_number_is_no_measurement_in_a_packed_image() -> None:
    image = np.array([[500, 65535], [65534, 0]], np.uint16)
    np.testing.assert_allclose(decode_depth(rvl(image), "image", 1000.0), [[0.5, 0], [65.534, 0]])


def test_seven_scenes_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    content = Content(12)
    dataset = open_dataset(write_seven_scenes(tmp_path, content))
    assert list(dataset.frame_names[:3]) == ["frame-000000", "frame-000010", "frame-000020"]
    assert dataset.read(11).stamp == pytest.approx(110 / 30)


def test_tum_drops_depth_without_a_pose_near_enough(tmp_path: Path) -> None:
    content = Content(10)
    folder = write_tum(tmp_path, content)
    poses = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(poses[:4] + poses[6:]))  # frames 3 and 4 lose theirs
    dataset = open_dataset(folder)
    assert dataset.dropped == 2
    assert any(note.startswith("2 of 10 depth images dropped") for note in dataset.notes)
    kept = [0, 1, 2, 5, 6, 7, 8, 9]
    for i, frame in zip(kept, dataset, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, content.poses[i], atol=1e-9)
        np.testing.assert_array_equal(frame.color, content.color[i])
    # With a gap that reaches the neighbours' poses, those still go to the frames that are closest.
    assert open_dataset(folder, max_time_gap=0.03).dropped == 2


def rescaled(path: Path, times: float, head: str = "#") -> None:
    """Multiply the first number of each line of a list."""
    lines = [line.split(maxsplit=1) for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("\n".join([head, *(f"{float(stamp) * times!r} {rest}" for stamp, rest in lines)]))


@pytest.mark.parametrize(
    ("times", "short", "unit"),
    [(1e3, "ms", "milliseconds"), (1e6, "us", "microseconds"), (1e9, "ns", "nanoseconds")],
)
@pytest.mark.parametrize("first_s", [0.0, 99.5])
def test_stamps_in_another_unit_than_the_images_are_named_with_the_remedy(
    tmp_path: Path, times: float, short: str, unit: str, first_s: float
) -> None:
    """Clocks that start at 0: the stamps' size does not tell the unit, and some go beyond those of 1973."""
    folder = write_tum(tmp_path, Content(24), first_s)
    poses = folder / "groundtruth.txt"
    (tmp_path / "poses.txt").write_text(poses.read_text())
    rescaled(poses, times)
    named = f"stamps of the poses are {times:.0f} times those of the depth images"
    refused(folder, named, f"they seem to be {unit}", f"'# stamp_{short} tx ty tz qx qy qz qw'")
    rescaled(poses, 1.0, f"# stamp_{short} tx ty tz qx qy qz qw")
    assert len(open_dataset(folder)) == 24
    rescaled(tmp_path / "poses.txt", times)
    with pytest.raises(DatasetError, match=r"stamps of the poses are .* those of the frames"):
        open_posed(folder, tmp_path / "poses.txt")
    rescaled(poses, 1 / times)
    rescaled(folder / "depth.txt", times)
    refused(folder, "those of the poses", f"divide those of the depth images by {times:.0f}")


def test_the_remedy_mends_stamps_of_a_clock_that_are_as_large_as_those_of_1973(tmp_path: Path) -> None:
    """Nanoseconds from the 100th second on are taken for milliseconds since 1970."""
    folder = write_tum(tmp_path, Content(24), 100.0)
    rescaled(folder / "groundtruth.txt", 1e9)
    said = refused(folder, "their unit is not the one assumed", "(or stamp_us, stamp_ms)")
    (line,) = re.findall("'(# stamp_.*?)'", said)
    rescaled(folder / "groundtruth.txt", 1.0, line)
    assert len(open_dataset(folder)) == 24


def test_tum_without_colour_and_unsorted(tmp_path: Path) -> None:
    content = Content(4)
    folder = write_tum(tmp_path, content)
    (folder / "rgb.txt").unlink()
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(reversed(lines)))
    check_frames(open_dataset(folder), content, 5000.0, colored=False)


def test_icl_images_outside_the_trajectory_are_dropped_and_counted(tmp_path: Path) -> None:
    """The published trajectories begin at image 1, the images at 0."""
    content = Content(6)
    write_numbered(tmp_path, content, first=0)
    write_freiburg(tmp_path / "livingRoom2.gt.freiburg", content.poses[1:5], first=1)
    dataset = open_dataset(tmp_path)
    assert list(dataset.frame_names) == ["00001", "00002", "00003", "00004"]
    assert dataset.dropped == 2
    assert any("2 of 6 images dropped" in note for note in dataset.notes)
    np.testing.assert_allclose(dataset.read(0).T_world_camera, content.poses[1], atol=1e-9)


def test_stamps_in_names_of_images_count(tmp_path: Path) -> None:
    """As in Redwood's own scans."""
    folder = write_redwood(tmp_path / "recording", Content(3))
    for i, path in enumerate(sorted((folder / "depth").iterdir())):
        path.rename(path.with_name(f"{path.stem}-{1000000 + 33000 * i:012d}.png"))
    assert [frame.stamp for frame in open_dataset(folder)] == [1.0, 1.033, 1.066]


@pytest.mark.parametrize(("write", "steps"), [(write_rows, 5000.0), (write_log, 1000.0)])
@pytest.mark.parametrize("first", [0, 7])
def test_images_taken_out_of_a_recording_keep_their_poses(
    tmp_path: Path, write: Callable[[Path, list[Pose]], Path], steps: float, first: int
) -> None:
    content = Content(8)
    write_numbered(tmp_path, content, first=first)
    write(tmp_path / "trajectory.txt", content.poses)
    (tmp_path / f"{first + 3:05d}.png").unlink()
    dataset = open_dataset(tmp_path)
    for frame in dataset:
        i = int(frame.name) - first
        np.testing.assert_allclose(frame.T_world_camera, content.poses[i], atol=1e-9)
        np.testing.assert_allclose(frame.depth_m, content.depth[i] / steps, rtol=1e-6)
    assert any("7 images but 8 poses" in note for note in dataset.notes)


def test_reading_is_lazy_and_repeatable(tmp_path: Path) -> None:
    content = Content(3)
    folder = write_house(tmp_path, content)
    dataset = open_dataset(folder)
    once, again = dataset.read(2), dataset.read(2)
    np.testing.assert_array_equal(once.depth_m, again.depth_m)
    (folder / "00181.png").unlink()
    np.testing.assert_array_equal(dataset.read(2).depth_m, once.depth_m)
    for index in (3, -1):
        with pytest.raises(IndexError, match="3 frames"):
            dataset.read(index)


@pytest.mark.parametrize("images", [10**3, 10**6, 10**9])
@pytest.mark.parametrize("poses", [1, 10**9])
def test_names_of_images_that_are_times_find_their_poses(tmp_path: Path, images: int, poses: int) -> None:
    """In ms, us or ns since 1970; poses are in seconds or in ns, 4 ms later."""
    content = Content(3)
    times = [1_600_000_000.5 + 0.25 * i for i in range(3)]
    for time, depth in zip(times, content.depth, strict=True):
        write_image(tmp_path / "depth" / f"{round(time * images)}.png", depth)
    (tmp_path / "camera.txt").write_text(CAMERA_TXT)
    lines = []
    for time, pose in zip([*times, 1_600_000_900.0], [*content.poses, content.poses[0]], strict=True):
        _, values = stamped_line(0.0, pose).split(maxsplit=1)
        lines.append(
            f"{time + 0.004:.3f} {values}" if poses == 1 else f"{round((time + 0.004) * 1000)}000000 {values}"
        )
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    dataset = open_dataset(tmp_path)
    assert list(dataset.stamps()) == pytest.approx(times)
    for frame, pose in zip(dataset, content.poses, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in WHOLE_NUMBERS if "bag" not in name])
def test_many_largest_numbers_are_a_note(tmp_path: Path, name: str) -> None:
    content = Content(6)
    for image in content.depth:
        image[:3] = 65535
    notes = open_dataset(WHOLE_NUMBERS[name](tmp_path / "recording", content)).notes
    assert len([note for note in notes if re.search(r"25% of the pixels of \d frames looked at", note)]) == 1


@pytest.mark.parametrize("suffix", [".tif", ".tiff"])
@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_depth_images_may_be_tiff(tmp_path: Path, suffix: str, kind: type) -> None:
    """Of 16 bits, or of floats, which are metres."""
    content = Content(3)
    for i, depth in enumerate(content.depth):
        values = depth if kind is np.uint16 else depth / np.float32(1000)
        if kind is not np.uint16:
            values[2, :2] = np.nan, -1.0
        write_image(tmp_path / f"depth/{i}{suffix}", values)
    (tmp_path / "camera.txt").write_text(CAMERA_TXT)
    write_log(tmp_path / "trajectory.log", content.poses)
    for scale in (None, 500.0):
        dataset = open_dataset(tmp_path, depth_scale=scale)
        for frame, depth in zip(dataset, content.depth, strict=True):
            expected = depth.astype(np.float32)
            if kind is np.float32:
                expected[2, :2] = 0
            metres = 1000 if kind is np.float32 or scale is None else 1
            np.testing.assert_allclose(frame.depth_m, expected / metres / (scale or 1), rtol=1e-6)


RECORDINGS = {
    "seven_scenes_redkitchen": (100, PinholeCamera(640, 480, 585, 585, 320, 240)),
    "icl_nuim_livingroom_traj2": (10, ICL_NUIM),
    "house_livingroom": (40, PRIMESENSE),
}


def disagreement(a: Frame, b: Frame) -> float:
    """Median difference in metres of a's depth, seen from b, to b's own, over the pixels that both see."""
    depth = a.depth_m[::4, ::4].astype(np.float64)
    seen = depth > 0
    points = a.camera.rays()[::4, ::4][seen] * depth[seen][:, None]
    T_b_a = inverse(b.T_world_camera) @ a.T_world_camera
    x, y, z = (points @ T_b_a[:3, :3].T + T_b_a[:3, 3]).T
    k = b.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.round(k.fx * x / z + k.cx), np.round(k.fy * y / z + k.cy)
        inside = (z > 0.1) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    measured = b.depth_m[v[inside].astype(int), u[inside].astype(int)].astype(np.float64)
    difference = np.abs(measured - z[inside])[measured > 0]
    assert len(difference) > 1000
    return float(np.median(difference))


def median_disagreement(folder: Path, camera: PinholeCamera | None = None, apart: int = 1) -> float:
    dataset = open_dataset(folder, camera=camera, color=False)
    frames = [dataset.read(i) for i in range(0, min(len(dataset), 10))]
    return float(np.median([disagreement(a, b) for a, b in zip(frames, frames[apart:], strict=False)]))


@pytest.mark.shared_data
@pytest.mark.parametrize("name", RECORDINGS)
def test_all_frames_open(shared_data: Path, name: str) -> None:
    count, camera = RECORDINGS[name]
    dataset, is_read = open_dataset(shared_data / name), name == "seven_scenes_redkitchen"
    assert any("assumed" in note for note in dataset.notes) != is_read
    assert len(dataset) == count
    assert dataset.camera == camera
    assert dataset.dropped == 0
    for frame in dataset:
        assert frame.depth_m.shape == (480, 640)
        assert np.isfinite(frame.depth_m).all()
        assert (frame.depth_m >= 0).all()
        assert frame.depth_m.max() < 20  # a sentinel of 65535 mm would be 65 m
        assert (frame.depth_m > 0).mean() > 0.5
        R = frame.T_world_camera[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert (frame.color is not None) == is_read


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "within"),
    [
        ("house_livingroom", 0.004),  # rendered: what is left is half a pixel on slanted surfaces
        ("icl_nuim_livingroom_traj2", 0.003),  # the same, with the views closer together
        ("seven_scenes_redkitchen", 0.012),  # a real Kinect and KinectFusion's poses
    ],
)
def test_views_of_one_recording_agree(shared_data: Path, name: str, within: float) -> None:
    assert median_disagreement(shared_data / name) < within


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "wrong", "apart"),
    [("icl_nuim_livingroom_traj2", PRIMESENSE, 4), ("house_livingroom", ICL_NUIM, 1)],
)
def test_the_assumed_camera_fits_better_than_the_other(
    shared_data: Path, name: str, wrong: PinholeCamera, apart: int
) -> None:
    folder = shared_data / name
    assert median_disagreement(folder, apart=apart) < 0.7 * median_disagreement(folder, wrong, apart)


@pytest.mark.shared_data
def test_the_data_folder_itself_names_its_recordings(shared_data: Path) -> None:
    refused(shared_data, "seven_scenes_redkitchen")
