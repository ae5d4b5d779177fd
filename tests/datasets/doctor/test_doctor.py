"""The usual mistakes of conventions are found, and nothing in what is as it should be."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from broken_recordings import BREAKS, FLAGS, LATE_S, Break, late, of_depth, of_focal, of_poses
from console import carry_out
from datasets_recordings import stamped_line, write_image
from inputs_frames import of_frames
from stereo_rig import write_kitti

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.conventions import Conventions
from taichi_mrf.datasets.doctor.diagnosis import Diagnosis, Finding, diagnose, doubtful_at_a_glance, mistakes
from taichi_mrf.datasets.doctor.picture import overlap
from taichi_mrf.datasets.doctor.remedy import remedy
from taichi_mrf.datasets.pose_sources.posed import open_posed
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.datasets.synthetic.analytic_render import render
from taichi_mrf.errors import DatasetError, ReadWrongError
from taichi_mrf.geometry.poses import inverse, look_at
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.source import open_source

SHARED = {
    "seven_scenes_redkitchen": 100,
    "icl_nuim_livingroom_traj2": 10,
    "house_livingroom": 40,
    "coffin_world": 12,
    "stereo_kitti/KITTI_sequence_1": 51,
    "lidar_building": 59,
    "la3dm_structured": 12,
}


@pytest.fixture
def room(one_backend: None) -> list[Frame]:
    return rendered()


@cache
def rendered() -> list[Frame]:
    return list(open_dataset("synthetic:room?frames=24&width=160&height=120", color=False))


@cache
def kitchen(folder: Path) -> list[Frame]:
    return list(open_dataset(folder / "seven_scenes_redkitchen", color=False))


def broken(frames: Sequence[Frame], *names: str) -> Sequence[Frame]:
    for name in names:
        frames = BREAKS[name](frames)
    return frames


def assert_named(found: Diagnosis, name: str, frames: Sequence[Frame]) -> None:
    (finding,) = found.findings
    assert finding.flag.startswith(FLAGS[name])
    if name == "intrinsics":
        k, read = frames[0].camera, [float(word) for word in finding.flag.split()[1].split(",")]
        np.testing.assert_allclose(read, (k.fx, k.fy, k.cx, k.cy), rtol=1e-5)
    elif name == "late":
        # Between frames poses are interpolated, which tells the time to a tenth of their distance.
        apart = frames[1].stamp - frames[0].stamp
        assert abs(float(finding.flag.split("=")[1]) - LATE_S) <= 0.1 * apart
    else:
        assert finding.flag == FLAGS[name]


@pytest.mark.parametrize("name", ["late", "intrinsics"])
def test_the_mistake_in_a_broken_room_is_named(room: list[Frame], name: str) -> None:
    assert_named(diagnose(of_frames(broken(room, name))), name, room)


@pytest.mark.shared_data
@pytest.mark.parametrize("name", BREAKS)
def test_the_mistake_in_a_broken_kitchen_is_named(shared_data: Path, name: str) -> None:
    frames = kitchen(shared_data)
    assert_named(diagnose(of_frames(broken(frames, name))), name, frames)


@pytest.mark.parametrize(
    ("names", "flags"),
    [
        (("opengl", "inverse"), {"--poses-are inverse,opengl"}),
        (("ros", "wxyz"), {"--poses-are wxyz,ros"}),
        (
            ("turned-left", "opengl", "unit"),
            {"--poses-are opengl", "--depth-scale 1000", "--image-is turned-left"},
        ),
        (("inverse", "range", "unit"), {"--poses-are inverse", "--depth-scale 1000", "--depth-is range"}),
    ],
)
def test_mistakes_that_come_together_are_told_apart(
    room: list[Frame], names: tuple[str, ...], flags: set[str]
) -> None:
    assert {each.flag for each in diagnose(of_frames(broken(room, *names))).findings} == flags


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.1, 1.25])
def test_a_focal_length_that_is_off_by_a_tenth_is_a_number(room: list[Frame], factor: float) -> None:
    (finding,) = diagnose(of_frames(of_focal(factor)(room))).findings
    assert finding.text.startswith("the focal length is ")
    read = [float(word) for word in finding.flag.removeprefix("--camera ").split(",")]
    np.testing.assert_allclose(read[:2], room[0].camera.fx, rtol=0.02)
    np.testing.assert_allclose(read[2:], (room[0].camera.cx, room[0].camera.cy))


@pytest.mark.shared_data
def test_a_focal_length_that_is_off_by_a_tenth_is_found_in_a_kitchen(shared_data: Path) -> None:
    frames = kitchen(shared_data)
    (finding,) = diagnose(of_frames(of_focal(1.1)(frames))).findings
    read = float(finding.flag.removeprefix("--camera ").split(",")[0])
    assert abs(read / frames[0].camera.fx - 1) < 0.03


@pytest.mark.parametrize(
    "change",
    [
        late(0.03),
        of_poses(lambda T: np.block([[T[:3, :3], 1.1 * T[:3, 3:]], [0, 0, 0, 1]])),
        of_depth(lambda f: 0.92 * f.depth_m),
        of_focal(1.04),
    ],
    ids=["late", "poses of another scale", "depth of another scale", "little"],
)
def test_what_is_not_the_focal_length_is_not_called_so(room: list[Frame], change: Break) -> None:
    assert not any("focal" in each.text for each in diagnose(of_frames(change(room))).findings)


def test_intrinsics_that_change_are_named_where_the_images_do_not(room: list[Frame]) -> None:
    wrong = [*room[:13], *of_focal(1.3)(room[13:])]
    (finding,) = diagnose(of_frames(wrong)).findings
    k = room[0].camera
    assert "change at frame " + room[13].name in finding.text
    assert f"from fx {k.fx:g} to {1.3 * k.fx:g}" in finding.text
    assert finding.flag == f"--camera {k.fx:.6g},{k.fy:.6g},{k.cx:.6g},{k.cy:.6g}"


def test_a_lens_that_zooms_is_as_it_should_be(room: list[Frame]) -> None:
    scene = open_dataset("synthetic:room?frames=24", color=False).scene  # type: ignore[attr-defined]
    frames = []
    for i, frame in enumerate(room):
        k = replace(frame.camera, fx=frame.camera.fx * (1 + i / 60), fy=frame.camera.fy * (1 + i / 60))
        frames.append(replace(frame, depth_m=render(scene, k, frame.T_world_camera, False)[0], camera=k))
    assert diagnose(of_frames(frames)).findings == ()


def test_one_image_of_another_size_is_named_before_map_stops_at_it(
    room: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_numbered(tmp_path / "mine", room)
    write_image(folder / "depth/0010.png", np.full((60, 80), 1000, np.uint16))
    assert carry_out("info", folder) == 2
    said = " ".join(capsys.readouterr().out.split())
    assert "0010.png" in said
    assert "80 x 60 pixels, the camera 160 x 120" in said


def test_swapped_bytes_of_depth_are_named(
    room: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_numbered(tmp_path / "mine", room)
    assert carry_out("doctor", folder) == 0
    for file in sorted((folder / "depth").iterdir()):
        write_image(file, cv2.imread(str(file), cv2.IMREAD_UNCHANGED).byteswap())
    capsys.readouterr()
    assert carry_out("doctor", folder) == 4
    said = capsys.readouterr().out
    assert said.startswith("the two bytes of each 16-bit depth are swapped")
    assert "Nothing odd" not in said
    with pytest.raises(ReadWrongError, match="two bytes"):
        carry_out("map", folder, "--out", tmp_path / "out", "--quiet")


def test_nothing_is_found_in_the_room_as_it_is(room: list[Frame]) -> None:
    found = diagnose(of_frames(room))
    assert (found.findings, found.undecided) == ((), ())
    assert found.before == found.after


@pytest.mark.shared_data
@pytest.mark.parametrize("name", SHARED)
def test_nothing_is_found_in_real_recordings(shared_data: Path, name: str) -> None:
    dataset = open_dataset(shared_data / name, color=False)
    assert len(dataset) == SHARED[name]
    assert diagnose(dataset).findings == ()


def test_a_camera_that_turns_in_place_does_not_tell_the_unit(room: list[Frame]) -> None:
    scene = open_dataset("synthetic:room?frames=40", color=False).scene  # type: ignore[attr-defined]
    camera, frames = room[0].camera, []
    for i in range(30):
        angle = 0.06 * i
        T = look_at((0, 0, 0), (np.cos(angle), np.sin(angle), 0.3 * np.sin(3 * angle)))
        frames.append(Frame(render(scene, camera, T, False)[0], T, camera, i / 10, f"{i}"))
    found = diagnose(of_frames(frames))
    assert found.findings == ()
    assert "the unit of depth" in found.undecided
    assert "the direction of poses" not in found.undecided
    still = diagnose(of_frames([replace(room[0], stamp=i / 10) for i in range(30)]))
    assert still.findings == ()
    assert {"the unit of depth", "the direction of poses", "the time of poses"} <= set(still.undecided)


def in_millimetres(frames: Sequence[Frame]) -> list[Frame]:
    return of_poses(lambda T: np.block([[T[:3, :3], 1000 * T[:3, 3:]], [np.eye(4)[3:]]]))(frames)


def test_poses_that_cannot_be_are_named(room: list[Frame]) -> None:
    same = [replace(frame, T_world_camera=room[0].T_world_camera) for frame in room]
    (finding,) = diagnose(of_frames(same)).findings
    assert "all the same" in finding.text
    assert "--poses FILE" in finding.text
    (finding,) = diagnose(of_frames(in_millimetres(room))).findings
    assert (finding.text, finding.flag) == ("poses are in millimetres", "--poses-are mm")
    (finding,) = diagnose(of_frames(broken(in_millimetres(room), "opengl"))).findings[1:]
    assert (finding.text, finding.flag) == ("poses are in millimetres", "--poses-are opengl,mm")
    (finding,) = diagnose(of_frames(room), Conventions(unit="mm")).findings
    assert (finding.text, finding.flag) == ("poses are in metres", "--poses-are ''")
    both = [replace(f, depth_m=np.rint(1000 * f.depth_m) / np.float32(5000)) for f in in_millimetres(room)]
    assert [finding.flag for finding in diagnose(of_frames(both)).findings] == [
        "--poses-are mm",
        "--depth-scale 1000",
    ]


@pytest.mark.parametrize("states_size", [False, True])
def test_turned_images_are_found_and_read(room: list[Frame], states_size: bool, tmp_path: Path) -> None:
    """With a camera file of the sensor's size no image fits it."""
    folder, k = write_numbered(tmp_path / "mine", broken(room, "turned-left")), room[0].camera
    if states_size:
        (folder / "K.txt").unlink()
        (folder / "camera.txt").write_text(f"{k.width} {k.height} {k.fx} {k.fy} {k.cx} {k.cy}")
    found = remedy(str(folder), None, SourceFlags())
    assert f"map {folder} --image-is turned-left" in found.command
    wrong = remedy(str(folder), None, SourceFlags(image_is="turned-right", depth_scale=1000.0))
    assert f"map {folder} --depth-scale=1000.0 --image-is turned-left" in wrong.command
    read = open_dataset(folder, image_is="turned-left", depth_scale=1000, color=False)
    assert diagnose(read).findings == ()
    assert read.read(3).camera == k
    np.testing.assert_allclose(read.read(3).depth_m, room[3].depth_m, atol=6e-4)


def test_a_sensor_that_moves_farther_than_it_sees_is_a_note(room: list[Frame], tmp_path: Path) -> None:
    """Also where frames are too few for a reading that explains them."""
    for name, frames in (("right", room), ("wrong", in_millimetres(room))):
        folder = write_tum(tmp_path / name, frames[::5])
        notes = " ".join(open_dataset(folder, depth_scale=1000).notes)
        assert ("farther than it sees" in notes and "such as millimetres" in notes) == (name == "wrong")
        found = diagnose(open_dataset(folder, depth_scale=1000)).findings
        assert any("millimetres" in finding.text for finding in found) == (name == "wrong")


def test_a_short_recording_of_quick_turns_is_understood(room: list[Frame]) -> None:
    camera, frames = replace(room[0].camera, width=80, height=60, fx=62, fy=62, cx=39.5, cy=29.5), []
    scene = open_dataset("synthetic:room?frames=40", color=False).scene  # type: ignore[attr-defined]
    for angle in np.arange(24) * np.pi / 12:
        eye = np.array([0.4 * np.cos(angle), 0.5 * np.sin(angle), 0.0])
        ahead = (np.cos(2 * angle), np.sin(2 * angle), 0.3 * np.sin(3 * angle))
        T = look_at(tuple(eye), tuple(eye + ahead))
        frames.append(Frame(render(scene, camera, T, False)[0], T, camera, angle, f"{angle}"))
    assert diagnose(of_frames(frames)).findings == ()
    (finding,) = diagnose(of_frames(broken(frames, "opengl"))).findings
    assert finding.flag == "--poses-are opengl"


def test_frames_that_see_different_things_tell_nothing(room: list[Frame]) -> None:
    apart = diagnose(of_frames([room[0], replace(room[20], name="other")]))
    assert apart.findings == ()
    assert len(apart.undecided) == 1
    assert apart.undecided[0].startswith("how it is written")
    assert overlap(apart) is None


def test_what_has_no_poses_is_refused(room: list[Frame]) -> None:
    dataset = of_frames(room)
    dataset.tracked = True
    with pytest.raises(DatasetError, match="no recorded poses"):
        diagnose(dataset)


def test_swapped_images_of_a_stereo_rig_are_found(tmp_path: Path) -> None:
    street = write_kitti(tmp_path / "street")
    assert diagnose(open_dataset(street)).findings == ()
    left, right, aside = (street / name for name in ("image_l", "image_r", "aside"))
    left.rename(aside)
    right.rename(left)
    aside.rename(right)
    (finding,) = diagnose(open_dataset(street)).findings
    assert finding.text.startswith("the left and right images are swapped")


def write_tum(folder: Path, frames: Sequence[Frame]) -> Path:
    """Millimetres, as many write them in this layout, whose unit is another."""
    for frame in frames:
        write_image(folder / f"depth/{frame.stamp:.2f}.png", np.rint(1000 * frame.depth_m).astype(np.uint16))
    k = frames[0].camera
    (folder / "camera.txt").write_text(f"{k.width} {k.height} {k.fx} {k.fy} {k.cx} {k.cy}")
    (folder / "depth.txt").write_text("\n".join(f"{f.stamp:.2f} depth/{f.stamp:.2f}.png" for f in frames))
    lines = [stamped_line(f.stamp, f.T_world_camera) for f in frames]
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    return folder


def test_the_flags_that_are_named_mend_a_recording(
    room: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_tum(tmp_path / "mine", broken(room, "opengl", "inverse"))
    picture = tmp_path / "overlap.png"
    assert carry_out("doctor", folder, "--picture", picture) == 4
    out = capsys.readouterr().out
    flags = ("--poses-are", "inverse,opengl", "--depth-scale", "1000")
    assert f"taichi-mrf map {folder} {' '.join(flags)} --out DIR" in out
    green = np.count_nonzero((cv2.imread(str(picture)) == (80, 200, 60)).all(axis=-1), axis=0)
    half = len(green) // 2
    assert green[:half].sum() < 0.2 * green[half:].sum()
    assert carry_out("doctor", folder, *flags) == 0
    assert capsys.readouterr().out.startswith("Nothing odd was found.")
    alone = tmp_path / "alone.png"
    assert carry_out("doctor", "synthetic:room?frames=2&width=80&height=60", "--picture", alone) == 0
    assert f"{alone} is not written: no two frames" in capsys.readouterr().out
    assert not alone.exists()
    # What was said of it and is not so is a mistake too.
    wrong = ("--poses-are", "inverse,opengl,wxyz", "--depth-scale", "1000")
    assert carry_out("doctor", folder, *wrong, "--json") == 4
    facts = json.loads(capsys.readouterr().out)
    assert [each["flag"] for each in facts["findings"]] == ["--poses-are inverse,opengl"]
    assert facts["difference_mended"] < facts["difference"] / 2


@pytest.mark.parametrize("noise", ["checked", "auto"])
def test_map_names_the_mistake_and_learns_no_noise_from_it(
    room: list[Frame], noise: str, tmp_path: Path
) -> None:
    folder = write_tum(tmp_path / "mine", broken(room, "inverse"))
    out = tmp_path / "out"
    coarse = ("--voxel-size", 0.2, "--no-pictures", "--depth-scale", 1000, "--noise", noise, "--quiet")
    command = f"taichi-mrf map {folder} --depth-scale=1000.0 --poses-are inverse --out DIR"
    with pytest.raises(ReadWrongError, match=re.escape(f"poses are T_camera_world: {command}; --force")):
        carry_out("map", folder, "--out", out, *coarse)
    assert not (out / "map.npz").exists()
    assert carry_out("map", folder, "--out", out, *coarse, "--force") == 0
    report = json.loads((out / "report.json").read_text())
    (note,) = [note for note in report["notes"] if "contradict" in note]
    assert note.endswith(f"poses are T_camera_world: {command}.")
    assert report["noise"]["learnt"] is None
    assert "--noise auto" not in " ".join(report["notes"])


@pytest.mark.parametrize(("wrong", "depth_is"), [("inverse,opengl", "axial"), ("ros", "range")])
def test_map_says_the_words_of_a_pose_file_as_they_ought_to_be_written(
    room: list[Frame], wrong: str, depth_is: str, tmp_path: Path
) -> None:
    frames = broken(room, "opengl", *(["range"] if depth_is == "range" else []))
    folder, lines = write_tum(tmp_path / "mine", frames), tmp_path / "poses.txt"
    lines.write_text((folder / "groundtruth.txt").read_text())
    said = {"depth_scale": 1000, "depth_is": depth_is, "color": False}
    (mistake,) = mistakes(open_posed(folder, lines, poses_are=wrong, **said))
    assert mistake.endswith("(--poses-are opengl mends it)")


def test_a_glance_sees_the_mistake_too_before_live_begins(room: list[Frame], tmp_path: Path) -> None:
    assert not doubtful_at_a_glance(of_frames(room))
    folder = write_tum(tmp_path / "mine", broken(room, "opengl"))
    reading = SourceFlags(depth_scale=1000)
    _, notes = open_source(str(folder), Config(), every=1, limit=None, speed=1.0, loop=False, reading=reading)
    (note,) = [note for note in notes if "contradict" in note]
    assert "OpenGL" in note
    assert note.endswith("(--poses-are opengl mends it)")


def test_map_names_the_mistake_where_it_answers_hardly_any_pixel(room: list[Frame], tmp_path: Path) -> None:
    """Tenths of millimetres, which are read as millimetres, put all surfaces beyond the sensor's range."""
    folder = write_tum(tmp_path / "mine", [replace(f, depth_m=10 * f.depth_m) for f in room])
    coarse = ("--voxel-size", 0.2, "--no-pictures", "--depth-scale", 1000, "--quiet", "--sensor.max-depth", 9)
    assert carry_out("map", folder, "--out", tmp_path / "out", *coarse, "--force") == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    (note,) = [note for note in report["notes"] if "held-out pixels have no answer" in note]
    assert note.endswith(f"not 1000: taichi-mrf map {folder} --depth-scale 10000 --out DIR.")


def write_numbered(folder: Path, frames: Sequence[Frame], steps: float = 1000, unit: int = 1) -> Path:
    """Depth images and poses without a word on their units."""
    for i, frame in enumerate(frames):
        write_image(folder / f"depth/{i:04d}.png", np.rint(steps * frame.depth_m).astype(np.uint16))
    k = frames[0].camera
    np.savetxt(folder / "K.txt", [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    rows = [np.diag([1, 1, 1, unit]) @ f.T_world_camera[:3].T for f in frames]
    np.savetxt(folder / "poses.txt", [row.T.ravel() for row in rows])
    return folder


@pytest.mark.parametrize("flags", [(), ("--depth-scale", "1000")])
def test_two_units_are_one_search_and_the_command_reads_both(
    room: list[Frame], flags: tuple[str, ...], tmp_path: Path
) -> None:
    folder = write_numbered(tmp_path / "mine", room, unit=1000)
    with pytest.raises(ReadWrongError) as refused:
        carry_out("map", folder, *flags, "--out", tmp_path / "out", "--quiet")
    words = str(refused.value).split("taichi-mrf map ")[1].split(" --out DIR")[0]
    assert sorted(words.replace("=", " ").replace("1000.0", "1000").split()[1:]) == sorted(
        ["--poses-are", "mm", "--depth-scale", "1000"]
    )
    found = open_dataset(folder, poses_are="mm", depth_scale=1000, color=False)
    np.testing.assert_allclose(found.read(3).depth_m, room[3].depth_m, atol=6e-4)
    np.testing.assert_allclose(found.pose(3), room[3].T_world_camera, atol=1e-6)


def test_the_unit_of_depth_is_sought_at_poses_in_the_unit_that_is_said(
    room: list[Frame], tmp_path: Path
) -> None:
    dataset = open_dataset(write_numbered(tmp_path / "mine", room, unit=1000), poses_are="mm", color=False)
    np.testing.assert_allclose(dataset.read(3).depth_m, room[3].depth_m, atol=6e-4)


@pytest.mark.parametrize("words", ["mm", "inverse"])
def test_a_unit_of_depth_that_is_found_at_poses_as_they_are_said_is_not_asked_for(
    room: list[Frame], words: str, tmp_path: Path
) -> None:
    frames = [replace(f, T_world_camera=inverse(f.T_world_camera)) for f in room]
    folder = write_numbered(tmp_path / "mine", *((room, 1000, 1000) if words == "mm" else (frames,)))
    found = remedy(str(folder), None, SourceFlags(poses_are=words))
    assert (found.found.findings, found.command) == ((), "")


def test_the_unit_of_depth_is_sought_at_the_poses_of_a_file_too(room: list[Frame], tmp_path: Path) -> None:
    folder, lines = write_numbered(tmp_path / "mine", room), tmp_path / "poses.txt"
    (folder / "poses.txt").rename(lines)
    dataset = open_posed(folder, lines, color=False)
    np.testing.assert_allclose(dataset.read(3).depth_m, room[3].depth_m, atol=6e-4)
    (note,) = [note for note in dataset.notes if "steps per metre" in note]
    assert note.startswith("depth: 1000 steps per metre, found by comparing")


@pytest.mark.parametrize("steps", [4000, 6553.5])
def test_a_scale_that_few_use_is_found(room: list[Frame], steps: float, tmp_path: Path) -> None:
    folder = write_numbered(tmp_path / "mine", room, steps=steps)
    (finding,) = diagnose(open_dataset(folder, depth_scale=1000)).findings
    assert finding.flag == f"--depth-scale {steps:g}"


def test_a_number_for_what_was_not_seen_is_named_where_frames_contradict(room: list[Frame]) -> None:
    """Of each image a window that moves with the camera, as the sky does, is the sensor's longest range."""
    window = np.zeros(room[0].depth_m.shape, bool)
    window[10:, 20:] = True
    found = diagnose(of_frames([replace(f, depth_m=np.where(window, 30, f.depth_m)) for f in room]))
    assert found.contradicted
    assert [each.text for each in found.findings if "exactly 30 m" in each.text]


def test_a_unit_of_depth_that_nobody_has_is_not_named(room: list[Frame]) -> None:
    """As 256 steps per metre at positions in centimetres are read: a fit by chance."""
    found = diagnose(of_frames([replace(f, depth_m=f.depth_m * 2.56) for f in room]))
    assert found.findings == ()
    assert "none of the usual mistakes explains" in found.undecided[0]


def test_a_command_that_does_not_mend_a_recording_is_not_named(
    room: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = Diagnosis((Finding("poses are in centimetres", "--poses-are cm"),), before=0.2, after=0.001)
    monkeypatch.setattr("taichi_mrf.datasets.doctor.remedy.diagnose", lambda *each: wrong)
    assert carry_out("doctor", write_numbered(tmp_path / "mine", room[:4])) == 4
    said = capsys.readouterr().out
    assert "--poses-are cm" not in said
    assert "none of the usual mistakes explains" in said


def test_a_map_that_its_frames_contradict_ends_with_4_unless_forced(
    room: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing explains poses of other frames."""
    shuffled = np.random.default_rng(0).permutation(len(room))
    mixed = [replace(f, T_world_camera=room[k].T_world_camera) for f, k in zip(room, shuffled, strict=True)]
    folder = write_tum(tmp_path / "mine", mixed)
    coarse = ("--voxel-size", 0.2, "--no-pictures", "--depth-scale", 1000, "--quiet")
    assert carry_out("map", folder, "--out", tmp_path / "out", *coarse) == 4
    refused = json.loads((tmp_path / "out/report.json").read_text())["refused"]
    assert "held-out" in refused
    assert refused in capsys.readouterr().err
    assert carry_out("map", folder, "--out", tmp_path / "out", *coarse, "--overwrite", "--force") == 0
    assert carry_out("doctor", folder, "--depth-scale", 1000) == 4
    assert "none of the usual mistakes explains" in capsys.readouterr().out
