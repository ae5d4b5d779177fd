"""Sentences of the program on sources, and the flags that say how one is read."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import small_room
from console import taichi_mrf
from datasets_recordings import CAMERA, Content, write_seven_scenes
from inputs_bags import Bag, writing

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.summary import UNUSED_COLOR
from taichi_mrf.export.formats import export_map
from taichi_mrf.geometry.poses import look_at


def said(*arguments: str | Path) -> tuple[int, str, str]:
    """Exit status, output and errors of the program."""
    done = taichi_mrf(*arguments)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal in which no table is folded."""
    monkeypatch.setenv("COLUMNS", "200")


def fill(bag: Bag, poses: tuple[str, ...], frame: str = "optical", camera: str = "optical") -> None:
    bag.camera_info("/camera/depth/camera_info", camera, CAMERA)
    for i in range(11):
        depth = np.full(CAMERA.shape, 1000 + 100 * i, np.uint16)
        bag.image("/camera/depth/image_raw", 0.5 * i, frame, depth, "16UC1")
        for topic in poses:
            bag.pose_stamped(topic, 0.5 * i, "map", look_at([0.1 * i, 0, 0], [9, 0, 0]))
        bag.tf("/tf", 0.5 * i, "odom", "base", look_at([0.1 * i, 0, 0], [9, 0, 0]))
    bag.tf("/tf_static", 0.0, "base", "optical", look_at([0, 0, 0], [1, 0, 0]))


def test_info_of_a_bag_lists_what_is_in_it(tmp_path: Path) -> None:
    with writing(tmp_path / "walk.bag", "ros1") as bag:
        fill(bag, ())
    status, out, errors = said("info", tmp_path / "walk.bag")
    assert (status, errors) == (0, "")
    for words in (
        r"5\.0 s",
        r"/camera/depth/image_raw +│ +sensor_msgs/msg/Image +│ +11 +│ +2\.0 +│ +depth, 16UC1, frame optical",
        r"/tf_static +│ +tf2_msgs/msg/TFMessage +│ +1 ",
        r"tf odom -> base \(moving, 11 times\)",
        r"tf base -> optical \(fixed\)",
        r"frames +│ +11",
        r"camera +│ +16 x 12, fx 14, fy 15, cx 7\.5, cy 5\.5",
        r"depth +│ +1\.00 to 2\.00 m .* 100% of the pixels",
    ):
        assert re.search(words, out), words
    command = out.strip().splitlines()[-1]
    assert shlex.split(command) == ["taichi-mrf", "map", str(tmp_path / "walk.bag"), "--out", "DIR"]


def test_info_of_a_bag_that_leaves_a_choice_suggests_all_of_them(tmp_path: Path) -> None:
    with writing(tmp_path / "walk", "mcap") as bag:
        fill(bag, ("/vio/pose", "/slam/pose"))
    status, out, errors = said("info", tmp_path / "walk")
    assert (status, errors) == (2, "")  # map refuses it too
    assert "It cannot be mapped as it is" in out
    commands = [shlex.split(line) for line in out.splitlines() if line.startswith("taichi-mrf map")]
    sources = [command[2] for command in commands]
    assert sources == [f"{tmp_path / 'walk'}?pose={name}" for name in ("/slam/pose", "/vio/pose", "tf")]
    for source in sources:
        assert len(open_dataset(source)) == 11


@pytest.mark.parametrize(
    ("frame", "poses", "query"),
    [
        ("", (), "?optical=FRAME"),
        ("unheard_of", (), "?optical=FRAME"),
        ("", ("/slam/pose",), "?pose=/slam/pose&optical=FRAME"),
    ],
)
def test_info_of_a_bag_whose_images_are_of_no_known_frame_suggests_to_name_it(
    tmp_path: Path, frame: str, poses: tuple[str, ...], query: str
) -> None:
    with writing(tmp_path / "walk", "mcap") as bag:
        fill(bag, poses, frame, frame)
    status, out, errors = said("info", tmp_path / "walk")
    assert (status, errors) == (2, "")
    commands = [shlex.split(line) for line in out.splitlines() if line.startswith("taichi-mrf map")]
    assert commands[0][2] == f"{tmp_path / 'walk'}{query}"
    assert len(open_dataset(commands[0][2].replace("FRAME", "optical"))) == 11


def test_info_of_a_bag_does_not_suggest_what_it_refuses(tmp_path: Path) -> None:
    with writing(tmp_path / "walk", "mcap") as bag:
        fill(bag, (), camera="rear")
    status, out, errors = said("info", tmp_path / "walk")
    assert (status, errors) == (2, "")
    assert "It cannot be mapped as it is" in out
    assert f"taichi-mrf map {tmp_path / 'walk'} --out" not in out


def test_info_of_bags_that_need_more(tmp_path: Path) -> None:
    with writing(tmp_path / "walk.bag", "ros1") as bag:
        bag.image("/a/depth", 0.0, "optical", np.ones(CAMERA.shape, np.uint16), "16UC1")
    assert "walk.bag?poses=FILE' --camera fx,fy,cx,cy --out DIR" in said("info", tmp_path / "walk.bag")[1]
    with writing(tmp_path / "own.bag", "ros1") as bag:
        bag.image(
            "/device_0/sensor_0/Depth_0/image/data", 0.0, "0", np.ones(CAMERA.shape, np.uint16), "mono16"
        )
    assert (
        f"taichi-mrf map 'realsense:{tmp_path}/own.bag?poses=FILE'" in said("info", tmp_path / "own.bag")[1]
    )


@pytest.mark.parametrize("flags", [(), ("--json",)])
def test_info_of_a_recording_without_a_frame_that_can_be_read(tmp_path: Path, flags: tuple[str, ...]) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content())
    for image in folder.glob("*.depth.png"):
        image.write_bytes(image.read_bytes()[:60])
    status, out, _ = said("info", folder, *flags)
    assert status == 2
    assert "cut short" in out


def test_info_of_a_folder(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content())
    status, out, errors = said("info", folder, "--image-scale", "0.5", "--camera", "20,20,8,6")
    assert (status, errors) == (0, "")
    assert re.search(r"format +│ +7-Scenes", out)
    assert re.search(r"frames +│ +5", out)
    assert re.search(r"voxel size +│ +5 cm fits", out)
    assert re.search(r"camera +│ +8 x 6, fx 10, fy 10, cx 4, cy 3", out)
    assert "one in 2 rows and columns is read" in out
    flags = ["--camera=20,20,8,6", "--image-scale=0.5"]
    command = ["taichi-mrf", "map", str(folder), *flags, "--color", "--out", "DIR"]
    assert shlex.split(out.splitlines()[-1]) == command
    (folder / "frame-000000.depth.png").unlink()
    status, out, _ = said("info", folder)
    assert (status, "Note: frame frame-000000:" in out) == (2, True)
    assert said("info", folder, "--json")[0] == 2


def test_info_of_saved_maps(tmp_path: Path, one_backend: str) -> None:
    m = small_room.build([0, 1])
    names = ["map.npz", "map.bt"]
    m.save(tmp_path / names[0])
    export_map(m, tmp_path / names[1])
    for name, words in zip(names, ("MRFMap|mrf", "OctoMap"), strict=True):
        status, out, errors = said("info", tmp_path / name)
        assert (status, errors) == (0, "")
        assert re.search(words, out)
        assert re.search(rf"voxels +│ +[\d,]+ of {small_room.VOXEL_SIZE:g} m", out)
        assert re.search(r"extent +│ +x -?\d", out)
    status, out, _ = said("info", tmp_path / "map.npz", "--json")
    facts = json.loads(out)
    assert (status, facts["method"], facts["keyframes"]) == (0, "mrf", 2)
    assert facts["configuration"]["voxel_size"] == small_room.VOXEL_SIZE
    centres, _ = m.voxels(min_probability=0.5)
    lower, upper = np.array(facts["extent"])
    assert (lower <= centres.min(axis=0)).all()
    assert (centres.max(axis=0) <= upper).all()
    (tmp_path / "map.npz").write_bytes((tmp_path / "map.npz").read_bytes()[:-30])
    status, out, errors = said("info", tmp_path / "map.npz")
    assert (status, out, errors.count("\n")) == (2, "", 1)


def test_info_of_the_room(one_backend: str) -> None:
    status, out, errors = said("info", "synthetic:room?frames=3&width=40&height=30", "--arch", one_backend)
    assert (status, errors) == (0, "")
    assert re.search(r"format +│ +synthetic:room", out)
    assert re.search(r"camera path +│ +x -?\d+\.\d\d to", out)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.bag"], "no such folder or file"),
        (["{}", "--image-scale", "0.3"], "image_scale must be 1, 0.5"),
        (["{}", "--undistort=-0.1,0.2"], "--undistort takes k1,k2,p1,p2"),
    ],
)
def test_bad_sources_and_values_end_in_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    folder = write_seven_scenes(tmp_path / "office", Content())
    status, out, errors = said("info", *(argument.format(folder) for argument in arguments))
    assert (status, out) == (2, "")
    assert errors.startswith("taichi-mrf: ")
    assert errors.count("\n") == 1
    assert words in errors


def test_map_reads_as_its_flags_say(tmp_path: Path) -> None:
    """Half the pixels, half the depth, undistorted: the flags reach the reader."""
    folder = write_seven_scenes(tmp_path / "office", Content())
    flags = "--image-scale 0.5 --depth-scale 2000 --camera 20,20,8,6 --undistort=-0.1,0,0,0"
    settings = "--voxel-size 0.2 --evaluation.hold-out 0 --runtime.arch cpu --no-pictures --limit 1"
    words = shlex.split(flags) + shlex.split(settings)
    done = taichi_mrf("map", folder, "--out", tmp_path / "out", *words)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    told = open_dataset(
        folder,
        image_scale=0.5,
        depth_scale=2000.0,
        intrinsics=(20.0, 20.0, 8.0, 6.0),
        undistort=(-0.1, 0.0, 0.0, 0.0),
    )
    assert report["notes"] == [*told.notes, UNUSED_COLOR]
    measured = told.read(0).depth_m
    assert report["rays"] == np.count_nonzero(measured > 0.1)
