"""A fault of a source or a frame is said in one line that names it; other frames stay readable."""

import gzip
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import (
    Content,
    text_of,
    write_image,
    write_log,
    write_numbered,
    write_rows,
    write_seven_scenes,
    write_stamped,
    write_tum,
)
from laser_logs import write_npz
from point_clouds import write_ply
from refusals import bad_frame, refusal, refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import FrameError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good 7-Scenes recording of five frames."""
    return write_seven_scenes(tmp_path / "office", Content())


def test_sources_without_a_recording(tmp_path: Path) -> None:
    refused("synthetic:rooms", "did you mean 'synthetic:room'")
    refused("nonsense:whatever", "built-in sources are: synthetic:room")
    refused(tmp_path / "nowhere", str(tmp_path / "nowhere"), "synthetic:room")
    refused(tmp_path, str(tmp_path), "is empty", "frame-NNNNNN.depth.png", "groundtruth.txt", ".log")
    (tmp_path / "holiday.odt").write_bytes(b"")
    refused(tmp_path, str(tmp_path), "frame-NNNNNN.depth.png")
    for name in ("pose", "depth"):  # the folders of ScanNet, with depth of another kind
        (tmp_path / name).mkdir()
    (tmp_path / "depth" / "0.exr").write_bytes(b"something")
    refused(tmp_path, "unsupported format (0.exr)")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    refused(tmp_path, "unsupported format (0.exr); write them as an .npz with depth_m")


UNREAD = {
    "a.exr": "unsupported format (a.exr); write them as an .npz with depth_m",
    "a.hdf5": "unsupported format (a.hdf5)",
    "a.npy": "unsupported format (a.npy)",
    "a.zip": "is an archive; unpack it",
    "a.tar.gz": "is an archive; unpack it",
    "a.mp4": "is a video: it has colours, but a map needs depth",
    "a.svo": "a camera maker's own format",
    "a.fbx": "converted to .ply or .glb",
    "a.obj": "renders depth images of a mesh",
    "a.glb": "renders depth images of a mesh",
    "a.xyz": "convert each scan to a .ply or .pcd",
    "scan.bin": "contains lidar point clouds without poses",
    "walk.laz": "lidar point clouds without poses",
    "house.ply": "?poses=FILE' renders depth images of a mesh",
    "office.bt": "taichi-mrf import reads it",
    "scene.sens": "extract it",
}


@pytest.mark.parametrize("name", UNREAD)
def test_what_is_not_read_names_a_remedy(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"something")
    for source in (tmp_path / name, tmp_path):
        refused(source, UNREAD[name])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff"])
@pytest.mark.parametrize("place", [".", "rgb", "numbered"])
def test_only_colours(tmp_path: Path, suffix: str, place: str) -> None:
    for i, image in enumerate(Content(2).color):
        write_image(tmp_path / (f"{i}{suffix}" if place == "numbered" else f"{place}/view{i}{suffix}"), image)
    refused(tmp_path, "but no depth image (16-bit grey, or floats)")


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_depth_images_of_other_names(tmp_path: Path, suffix: str) -> None:
    for i, image in enumerate(Content(2).depth):
        write_image(tmp_path / f"view{i}{suffix}", image)
    refused(tmp_path, f"of depth (view0{suffix}) in an unsupported layout")
    refused(tmp_path / f"view0{suffix}", f"is one image of depth (view0{suffix})")


def test_a_file_of_a_recording_alone(folder: Path, tmp_path: Path) -> None:
    said = "is one file of a recording ("
    refused(folder / "camera.txt", str(folder / "camera.txt"), said)
    (tmp_path / "poses.csv").write_text("timestamp,tx,ty,tz,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n")
    refused(tmp_path / "poses.csv", f"with --poses {tmp_path / 'poses.csv'}")
    cloud = write_ply(tmp_path / "cloud.ply", np.zeros((3, 3)))
    refused(cloud, "contains lidar point clouds without poses")


@pytest.mark.parametrize("name", ["walk.log", "walk.log.gz", "scans.npz", "folder"])
def test_laser_scans_name_the_command_that_maps_them(tmp_path: Path, name: str) -> None:
    line = b"PARAM laser 1\nFLASER 3 1.0 2.0 3.0 0 0 0 0 0 0 1.5 host 1.5\n"
    path = tmp_path / name
    if name.endswith(".npz"):
        write_npz(path)
    elif name == "folder":
        path.mkdir()
        write_npz(path / "scans.npz")
    else:
        path.write_bytes(gzip.compress(line) if name.endswith("gz") else line)
    refused(path, f"taichi-mrf laser {path} --out DIR")


@pytest.mark.parametrize("layout", ["NNNN.cam.info.txt", "pose/NNNN.txt"])
def test_poses_in_a_file_for_each_image_name_the_flags(tmp_path: Path, layout: str) -> None:
    content = Content()
    for number, image in enumerate(content.depth):
        write_image(tmp_path / f"{number:04d}.png", image)
        write_frame_text(tmp_path / layout.replace("NNNN", f"{number:04d}"))
    refused(tmp_path, "--camera 14.5,15,7.5,5.5 and --depth-scale", "poses.txt")
    write_rows(tmp_path / "poses.txt", [np.eye(4)] * content.count)
    flags = {"intrinsics": (14.5, 15, 7.5, 5.5), "depth_scale": 1000.0}
    assert len(open_dataset(tmp_path, **flags)) == content.count  # type: ignore[arg-type]


def test_frames_with_a_text_file_each_name_the_pose_file(tmp_path: Path) -> None:
    for number, image in enumerate(Content().depth):
        write_image(tmp_path / f"frame-{number:06d}.depth.png", image)
        write_frame_text(tmp_path / f"frame-{number:06d}.cam.info.txt")
    refused(tmp_path, "into frame-NNNNNN.pose.txt, and pass --camera 14.5,15,7.5,5.5")


def write_frame_text(path: Path) -> None:
    """K and a pose, as cam.info.txt has them."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"K\n14.5 0 7.5\n0 15 5.5\n0 0 1\nT_world_camera\n{text_of(np.eye(4))}\n")


def test_a_folder_of_recordings_names_them(folder: Path) -> None:
    shutil.copytree(folder, folder.parent / "attic")
    assert "attic, office" in refused(folder.parent).split("contains several recordings; pass one of: ")[1]


@pytest.mark.parametrize(
    ("option", "value"),
    [("max_time_gap", -0.1), *(("depth_scale", scale) for scale in (0.0, -1.0, np.nan, np.inf))],
)
def test_a_scale_or_a_time_gap_that_is_none(folder: Path, option: str, value: float) -> None:
    refused(folder, option, **{option: value})


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("camera.txt", "640 480 525", "contains 3 numbers"),
        ("camera.txt", "640 480 fx fy 1 1", "not a number"),
        ("camera.txt", "16 12 -14 15 7.5 5.5", "both must be positive"),
        ("camera.txt", "16 12 nan 15 7.5 5.5", "fx is not finite"),
        ("camera.txt", "16.5 12 14 15 7.5 5.5", "not a whole number of pixels"),
        ("camera.txt", "nan 12 14 15 7.5 5.5", "not a whole number of pixels"),
        ("camera.txt", "inf 12 14 15 7.5 5.5", "not a whole number of pixels"),
        ("camera.yaml", "{width: 16, height: 12, fx: 14, fy: 15, cx: 7.5}", "cy is missing"),
        ("camera.yaml", "{width: 16, height: 12, fx: 1, fy: 1, cx: 1, cy: 1, k: 2}", "unknown parameter 'k'"),
        ("camera.yaml", "{width: wide, height: 12, fx: 1, fy: 1, cx: 1, cy: 1}", "width must be of type int"),
        ("camera.yaml", "[1, 2", "not valid YAML"),
        ("camera.yaml", "17", "expected a mapping"),
        ("camera-intrinsics.txt", "fx: 14\nfy: 15\ncx: 7.5\ncy: 5.5\nskew: 0.3", "skew"),
        ("camera-intrinsics.txt", "fx: 14\nfy: 15\ncx: 7.5", "cy missing"),
        ("K.txt", "14 0 7.5\n0 15 5.5\n0 0 2", "not the matrix of a pinhole camera"),
        ("intrinsics.txt", "# K\n14 0.3 7.5\n0 15 5.5\n0 0 1", "line 2: the matrix has skew 0.3"),
    ],
)
def test_a_camera_file_that_makes_no_sense(folder: Path, file: str, text: str, problem: str) -> None:
    (folder / "camera.txt").unlink()
    (folder / file).write_text(text)
    error = refused(folder)
    assert error.startswith(str(folder / file))
    assert problem in error
    assert error.count(file) == 1


def test_tum_with_poses_of_another_day_or_none(tmp_path: Path) -> None:
    poses = write_tum(tmp_path, Content()) / "groundtruth.txt"
    write_stamped(poses, [17.0], [np.eye(4)])
    refused(tmp_path, "none of 5 depth images", "within 0.02 s", "17.000")
    poses.unlink()
    refused(tmp_path, str(poses))


@pytest.mark.parametrize(
    ("name", "lines", "problem"),
    [
        ("depth.txt", "# nothing", "lists no image"),
        ("depth.txt", "1.0 " + "/".join(["d", "[" * 5000, "e"]), "line 1: no file has a name of 5000 bytes"),
        ("depth.txt", "1.0 depth/1.png\nyesterday depth/2.png", "line 2"),
        ("depth.txt", "1.0 depth/1.png\n2.0", "line 2"),
        ("depth.txt", "nan depth/1.png", "line 1"),
        ("groundtruth.txt", "1 2 3", "line 1"),
        ("groundtruth.txt", " ".join("1" * 12), "expected lines of stamp"),
    ],
)
def test_tum_lists_that_are_broken(tmp_path: Path, name: str, lines: str, problem: str) -> None:
    write_tum(tmp_path, Content())
    (tmp_path / name).write_text(lines)
    refused(tmp_path, str(tmp_path / name), problem)


def test_numbered_images_whose_trajectory_does_not_fit(tmp_path: Path) -> None:
    content = Content()
    write_numbered(tmp_path, content)
    refused(tmp_path, "without a trajectory")
    path = write_stamped(tmp_path / "traj.txt", [1305031102.5], [np.eye(4)])
    refused(tmp_path, f"{path}: its stamps are times, images are numbered, and 5 images cannot be")
    write_rows(tmp_path / "traj.txt", content.poses)
    write_log(tmp_path / "two.log", content.poses)
    refused(tmp_path, "traj.txt, two.log; keep one")


# Frame 3 of a 7-Scenes recording is damaged in turn; the error has to name it and the file.


DEPTH, POSE = "frame-000030.depth.png", "frame-000030.pose.txt"
Damage = Callable[[Path], Path]


def replace_depth(image: np.ndarray) -> Damage:
    return lambda folder: write_image(folder / DEPTH, image)


def edit(name: str, change: Callable[[bytes], bytes | None]) -> Damage:
    """Change the bytes of a file, or (None) remove it."""

    def apply(folder: Path) -> Path:
        path = folder / name
        data = change(path.read_bytes())
        path.unlink() if data is None else path.write_bytes(data)
        return path

    return apply


edit_depth = partial(edit, DEPTH)


def write_pose(text: str) -> Damage:
    return edit(POSE, lambda _: text.encode())


def remove(name: str) -> Damage:
    return edit(name, lambda _: None)


def flip_byte(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"

DAMAGES: dict[str, tuple[Damage, str]] = {
    "no image": (edit_depth(lambda _: b"this is no image"), "not a readable image"),
    "empty file": (edit_depth(lambda _: b""), "the file is empty"),
    "cut in the head": (edit_depth(lambda data: data[:20]), "cut short"),
    "cut in the middle": (edit_depth(lambda data: data[: len(data) // 2]), "cut short"),
    "cut at the end": (edit_depth(lambda data: data[:-3]), "cut short"),
    "flipped bits": (edit_depth(flip_byte), "damaged"),
    "8 bits": (replace_depth(np.zeros((12, 16), np.uint8)), "found 8-bit with 1 channel"),
    "colour": (replace_depth(np.zeros((12, 16, 3), np.uint8)), "found 8-bit with 3 channels"),
    "16-bit colour": (replace_depth(np.zeros((12, 16, 3), np.uint16)), "found 16-bit with 3 channels"),
    "wrong size": (replace_depth(np.zeros((24, 32), np.uint16)), "32 x 24 pixels, the camera 16 x 12"),
    "turned": (replace_depth(np.zeros((16, 12), np.uint16)), "12 x 16 pixels, the camera 16 x 12"),
    "no depth": (remove(DEPTH), "the image is missing"),
    "no pose": (remove(POSE), "the pose is missing"),
    "scaled": (write_pose(IDENTITY.replace("0 1 0 0", "0 1.2 0 0")), "rotation of a pose is not one"),
    "mirrored": (write_pose(IDENTITY.replace("0 1 0 0", "0 -1 0 0")), "reflection"),
    "projective": (write_pose(IDENTITY.replace("0 0 0 1", "0 0 1 1")), "last row"),
    "too short": (write_pose("1 0 0 0\n0 1 0 0"), "8 numbers"),
    "no numbers": (write_pose("one 0 0 0"), "line 1"),
    "broken colour": (
        lambda f: write_image(f / "frame-000030.color.png", np.zeros((6, 8, 3), np.uint8)),
        "8 x 6",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_bad_frame_is_named_and_the_next_can_be_read(folder: Path, damage: str) -> None:
    apply, problem = DAMAGES[damage]
    path = apply(folder)
    dataset = open_dataset(folder)
    assert len(dataset) == 5
    bad_frame(dataset, 3, str(path), problem)
    for index in (0, 1, 2, 4):
        dataset.read(index)
    frames = iter(dataset)
    assert [next(frames).name for _ in range(3)] == ["frame-000000", "frame-000010", "frame-000020"]
    with pytest.raises(FrameError):
        next(frames)


def test_a_bad_image_says_nothing_on_stderr(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """libpng and OpenCV would print their own complaints past Python."""
    for damage in ("cut in the middle", "flipped bits", "no image", "empty file"):
        write_seven_scenes(folder, Content())
        DAMAGES[damage][0](folder)
        with pytest.raises(FrameError):
            open_dataset(folder).read(3)
    assert capfd.readouterr() == ("", "")


def test_a_damaged_first_image_does_not_decide_the_size(folder: Path) -> None:
    (folder / "camera.txt").unlink()
    (folder / "camera-intrinsics.txt").write_text("14 0 7.5\n0 15 5.5\n0 0 1")
    (folder / "frame-000000.depth.png").write_bytes(b"")
    dataset = open_dataset(folder)
    assert dataset.camera.shape == (12, 16)
    bad_frame(dataset, 0, "frame-000000")


def test_a_nearly_orthonormal_rotation_is_projected(folder: Path) -> None:
    write_pose(IDENTITY.replace("0 1 0 0", "0 1.0004 0 0"))(folder)
    R = open_dataset(folder).read(3).T_world_camera[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("lost", ["nan 0 0 0 0 0 1", "0 0 0 0 0 0 0"])
def test_lost_poses_of_a_trajectory_are_left_out(tmp_path: Path, lost: str) -> None:
    content = Content()
    write_tum(tmp_path, content)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    words = lines[3].split()
    lines[3] = f"{words[0]} {lost}"
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    dataset = open_dataset(tmp_path)
    assert "1 of 5 poses of groundtruth.txt left out: tracking was lost" in dataset.notes
    assert (len(dataset), dataset.dropped) == (4, 1)
    np.testing.assert_allclose(dataset.read(2).T_world_camera, content.poses[3], atol=1e-6)


@pytest.mark.parametrize("first", [0, 180])
def test_a_trajectory_that_ends_early(tmp_path: Path, first: int) -> None:
    content = Content()
    write_numbered(tmp_path, content, first=first)
    write_rows(tmp_path / "T_world_camera.txt", content.poses[:3])
    dataset = open_dataset(tmp_path)
    assert len(dataset) == 5
    for i in range(3):
        np.testing.assert_allclose(dataset.read(i).T_world_camera, content.poses[i], atol=1e-9)
    with refusal(
        FrameError,
        f"frame {first + 4:05d}: {tmp_path / 'T_world_camera.txt'}: ",
        "has no pose for this image",
    ):
        dataset.read(4)
