"""Writes small recordings in every folder format, for the tests of their readers."""

import io
import json
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.camera import PinholeCamera

SIZE = (12, 16)
"""(height, width) of the images."""

CAMERA_TXT = "16 12 14 15 7.5 5.5"
CAMERA = PinholeCamera(16, 12, 14.0, 15.0, 7.5, 5.5)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass
class Content:
    """Content of a recording's frames: raw 16-bit depth, colour, and poses."""

    count: int = 5
    size: tuple[int, int] = SIZE
    depth: list[NDArray[np.uint16]] = field(init=False)
    color: list[NDArray[np.uint8]] = field(init=False)
    poses: list[Pose] = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.count)
        self.depth = [random.integers(400, 9000, self.size).astype(np.uint16) for _ in range(self.count)]
        self.color = [random.integers(0, 256, (*self.size, 3)).astype(np.uint8) for _ in range(self.count)]
        self.poses = [look_at(random.normal(size=3), random.normal(size=3)) for _ in range(self.count)]
        for image in self.depth:
            image[0, 0] = 0


def write_image(path: Path, image: NDArray) -> Path:
    """Write an image; three channels are RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image)
    assert ok
    path.write_bytes(data.tobytes())
    return path


def text_of(matrix: NDArray[np.float64]) -> str:
    """A matrix, row by row, with all its digits."""
    return "\n".join(" ".join(map(repr, row.tolist())) for row in matrix)


def row_of(matrix: NDArray[np.float64]) -> str:
    """A matrix in one line."""
    return text_of(matrix).replace("\n", " ")


def quaternion_of(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """x y z w of a rotation."""
    return Rotation.from_matrix(R).as_quat()


def stamped_line(stamp: float, pose: Pose) -> str:
    """stamp tx ty tz qx qy qz qw."""
    numbers = (stamp, *pose[:3, 3], *quaternion_of(pose[:3, :3]))
    return " ".join(repr(float(number)) for number in numbers)


def write_stamped(path: Path, stamps: Iterable[float], poses: Iterable[Pose]) -> Path:
    """A file of stamped poses."""
    path.write_text("\n".join(map(stamped_line, stamps, poses)) + "\n")
    return path


def write_seven_scenes(folder: Path, content: Content) -> Path:
    """Frames 0, 10, 20 ... with JPEG-free colour, so that it comes back exactly."""
    for i in range(content.count):
        stem = f"frame-{10 * i:06d}"
        write_image(folder / f"{stem}.depth.png", content.depth[i])
        write_image(folder / f"{stem}.color.png", content.color[i])
        (folder / f"{stem}.pose.txt").write_text(text_of(content.poses[i]))
    (folder / "camera.txt").write_text(CAMERA_TXT)
    return folder


def write_tum(folder: Path, content: Content, start: float = 1305031102.0) -> Path:
    """Depth each 33 ms, colour 4 ms and poses 7 ms later."""
    stamps = start + 0.033 * np.arange(content.count)
    for name, late_s, images in (("depth", 0.0, content.depth), ("rgb", 0.004, content.color)):
        lines = ["# stamp file"]
        for stamp, image in zip(stamps + late_s, images, strict=True):
            write_image(folder / f"{name}/{stamp:.6f}.png", image)
            lines.append(f"{stamp:.6f} {name}/{stamp:.6f}.png")
        (folder / f"{name}.txt").write_text("\n".join(lines))
    lines = ["# stamp pose", *map(stamped_line, stamps + 0.007, content.poses)]
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    (folder / "camera.txt").write_text(CAMERA_TXT)
    return folder


def write_numbered(folder: Path, content: Content, first: int = 0, place: str = ".") -> Path:
    """Numbered depth images without a trajectory, colour beside them if they lie in a folder of their own."""
    for i in range(content.count):
        write_image(folder / place / f"{first + i:05d}.png", content.depth[i])
        if place != ".":
            write_image(folder / "color" / f"{first + i:05d}.png", content.color[i])
    (folder / "camera.txt").write_text(CAMERA_TXT)
    return folder


def doubled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Each pixel twice along each side."""
    return np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)


def changed(values: dict[str, Any], changes: dict[str, object]) -> dict[str, Any]:
    """Values of which ``changes`` replace some, and None leaves them out."""
    return {name: value for name, value in (values | changes).items() if value is not None}


def write_rows(path: Path, poses: list[Pose]) -> Path:
    """One 3 x 4 matrix a line."""
    path.write_text("\n".join(row_of(pose[:3]) for pose in poses))
    return path


def write_log(path: Path, poses: list[Pose], first: int = 0) -> Path:
    """Choi's layout."""
    blocks = (f"{first + i} {first + i} {first + i + 1}\n{text_of(pose)}" for i, pose in enumerate(poses))
    path.write_text("\n".join(blocks))
    return path


K = np.array([[14.0, 0, 7.5], [0, 15.0, 5.5], [0, 0, 1]])


def write_scannet(folder: Path, content: Content, color: bool = False) -> Path:
    """Numbers without leading zeros, of which the tenth comes after the second. With ``color``, images of
    the depth camera's pixels."""
    for name in ("pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    wide = np.eye(4)
    wide[:3, :3] = K
    for name, images in (("depth", content.depth), *([("color", content.color)] if color else [])):
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text(text_of(wide))
        if color:
            (folder / f"intrinsic/extrinsic_{name}.txt").write_text(text_of(np.eye(4)))
        for i, image in enumerate(images):
            write_image(folder / f"{name}/{5 * i}.png", image)
    for i, pose in enumerate(content.poses):
        (folder / f"pose/{5 * i}.txt").write_text(text_of(pose))
    return folder


def write_stray(folder: Path, content: Content) -> Path:
    """Stray Scanner's layout; the images' levels of confidence are 0, 1, 2 from column to column."""
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(content.count):
        levels = np.broadcast_to(np.arange(256, dtype=np.uint8) % 3, (192, 256))
        depth = np.resize(content.depth[i], (192, 256))
        write_image(folder / f"depth/{i:06d}.png", depth)
        write_image(folder / f"confidence/{i:06d}.png", np.ascontiguousarray(levels))
        stamp, *pose = stamped_line(100 + 0.1 * i, content.poses[i]).split()
        lines.append(", ".join([stamp, f"{i:06d}", *pose]))
    (folder / "odometry.csv").write_text("\n".join(lines))
    (folder / "camera_matrix.csv").write_text("1500.0, 0.0, 959.5\n0.0, 1500.0, 719.5\n0.0, 0.0, 1.0\n")
    return folder


def write_record3d(
    path: Path, content: Content, pack: Callable[[bytes], bytes] = bytes, **changes: object
) -> Path:
    """A .r3d, or a folder if ``path`` ends in nothing, of frames of 16 x 12 pixels of depth and 32 x 24 of
    colour; levels are 0, 1, 2 from column to column. ``changes`` replace entries of the metadata, and None
    leaves them out."""
    height, width = content.size
    K_color = np.array([[28.0, 0, 2 * 7.5 + 0.5], [0, 30.0, 2 * 5.5 + 0.5], [0, 0, 1]])
    poses = [[*quaternion_of(T[:3, :3] @ np.diag([1.0, -1.0, -1.0])), *T[:3, 3]] for T in content.poses]
    metadata = {"w": 2 * width, "h": 2 * height, "dw": width, "dh": height, "fps": 10}
    metadata |= {"K": column_by_column(K_color), "poses": poses}
    metadata = changed(metadata, changes)
    levels = np.ascontiguousarray(np.broadcast_to(np.arange(width, dtype=np.uint8) % 3, content.size))
    members = {"metadata": json.dumps(metadata).encode()}
    for i in range(content.count):
        color = doubled(content.color[i])
        members[f"rgbd/{i}.depth"] = pack((content.depth[i] / np.float32(1000)).astype("<f4").tobytes())
        members[f"rgbd/{i}.conf"] = pack(levels.tobytes())
        members[f"rgbd/{i}.jpg"] = cv2.imencode(".png", color[..., ::-1])[1].tobytes()  # comes back exactly
    file = path if path.suffix else io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
        if not path.suffix:
            archive.extractall(path)
    return path


def write_replica(folder: Path, content: Content, place: str = "..") -> Path:
    """Its camera lies above the folder, or at another place from there."""
    for i in range(content.count):
        write_image(folder / f"results/depth{i:06d}.png", content.depth[i])
        write_image(folder / f"results/frame{i:06d}.png", content.color[i])
    (folder / "traj.txt").write_text("\n".join(row_of(pose) for pose in content.poses))
    camera = {"w": 16, "h": 12, "fx": 14.0, "fy": 15.0, "cx": 7.5, "cy": 5.5, "scale": 6553.5}
    (folder / place / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def write_nerfstudio(folder: Path, content: Content, **changes: object) -> Path:
    """Nerfstudio's layout: colour has twice the pixels of depth along each side. ``changes`` replace entries
    of transforms.json, and None leaves them out."""
    height, width = content.size
    frames = []
    for i in range(content.count):
        write_image(folder / f"depth/frame_{i + 1:05d}.png", content.depth[i])
        write_image(folder / f"images/frame_{i + 1:05d}.png", doubled(content.color[i]))
        files = {
            "file_path": f"images/frame_{i + 1:05d}.png",
            "depth_file_path": f"depth/frame_{i + 1:05d}.png",
        }
        T = content.poses[i] @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(files | {"transform_matrix": T.tolist()})
    values = {"camera_model": "OPENCV", "w": 2 * width, "h": 2 * height, "fl_x": 28.0, "fl_y": 30.0}
    values |= {"cx": 2 * 7.5 + 0.5, "cy": 2 * 5.5 + 0.5, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(changed(values, changes)))
    return folder


def column_by_column(matrix: np.ndarray) -> list[float]:
    return [float(x) for x in matrix.T.reshape(-1)]


INTRINSIC = {"width": 16, "height": 12, "intrinsic_matrix": column_by_column(K)}


def arrays(content: Content) -> dict[str, np.ndarray]:
    return {
        "depth_m": np.stack(content.depth) / np.float32(1000),
        "T_world_camera": np.stack(content.poses),
        "K": K,
        "stamp": np.arange(content.count) * 0.5,
        "color": np.stack(content.color),
    }


def write_npz(path: Path, values: dict[str, np.ndarray]) -> Path:
    np.savez_compressed(path, **values)  # type: ignore[arg-type]
    return path


def write_freiburg(path: Path, poses: list[Pose], first: int) -> None:
    """As ICL-NUIM publishes it: left-handed, y up."""
    path.write_text("\n".join(stamped_line(first + i, MIRROR @ T @ MIRROR) for i, T in enumerate(poses)))


def write_redwood(folder: Path, content: Content) -> Path:
    write_numbered(folder, content, place="depth")
    write_log(folder / "livingroom1-traj.txt", content.poses)
    return folder


def write_icl(folder: Path, content: Content) -> Path:
    write_numbered(folder, content, first=1)
    write_freiburg(folder / "livingRoom2.gt.freiburg", content.poses, first=1)
    return folder


def write_house(folder: Path, content: Content) -> Path:
    write_numbered(folder, content, first=180)
    write_rows(folder / "T_world_camera.txt", content.poses)
    return folder


class Format(NamedTuple):
    """A writer of a folder, and what is read of it if nothing is said: steps per metre, whether colours come,
    and the seconds of the first stamp and from one to the next."""

    write: Callable[[Path, Content], Path]
    steps: float
    colored: bool
    first_s: float
    step_s: float


FORMATS = {
    "seven_scenes": Format(write_seven_scenes, 1000.0, True, 0.0, 10 / 30),
    "tum": Format(write_tum, 5000.0, True, 1305031102.0, 0.033),
    "redwood": Format(write_redwood, 1000.0, True, 0.0, 1 / 30),
    "icl": Format(write_icl, 5000.0, False, 1 / 30, 1 / 30),
    "house": Format(write_house, 5000.0, False, 180.0, 1.0),  # nobody knows when: a second apart
    "scannet": Format(write_scannet, 1000.0, False, 0.0, 5 / 30),
    "replica": Format(write_replica, 6553.5, True, 0.0, 1 / 30),
    "nerfstudio": Format(write_nerfstudio, 1000.0, True, 0.0, 1.0),
}


def check_frames(
    dataset: Dataset, content: Content, steps: float, colored: bool = False, camera: PinholeCamera = CAMERA
) -> None:
    """The frames are those of the content, and of the camera."""
    assert dataset.camera == camera
    assert len(dataset) == len(dataset.frame_names) == content.count
    for i, frame in enumerate(dataset):
        np.testing.assert_allclose(frame.depth_m, content.depth[i] / np.float32(steps), rtol=1e-6)
        assert frame.depth_m.dtype == np.float32
        assert frame.depth_m[0, 0] == 0
        np.testing.assert_allclose(frame.T_world_camera, content.poses[i], atol=1e-9)
        assert (frame.camera, frame.name) == (camera, dataset.frame_names[i])
        if colored:
            np.testing.assert_array_equal(frame.color, content.color[i])
        else:
            assert frame.color is None
