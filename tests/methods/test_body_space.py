"""--body-space: where an arm of six joints was, there was nothing of the world; and what is near it stays."""

from pathlib import Path

import numpy as np
import pytest
from armed_room import box_depth_m, to_box_m
from inputs_frames import of_frames
from live_scene import marginals
from numpy.typing import NDArray

import taichi_mrf as tm
from taichi_mrf.alignment.se3 import moved
from taichi_mrf.datasets.conventions import AS_USUAL
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.without_body import without_body
from taichi_mrf.geometry.poses import Pose, inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

HALF_M = np.array([0.035, 0.04, 0.08])
SHOULDER_M = np.array([0.28, 0.3, 0.64])
"""Where the arm begins, in the camera frame."""

AXES = np.array([[0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], float)

WALL_HALF_M, ROD_HALF_M = np.array([3.0, 3.0, 0.1]), np.array([0.012, 0.5, 0.012])
T_WORLD_WALL = moved(np.eye(4), [0, 0, 1.15, 0, 0, 0])
T_WORLD_ROD = moved(np.eye(4), [0.02, 0, 0.94, 0, 0, 0])
"""What is behind the arm and near it."""


def angles_at(step: int) -> NDArray[np.float64]:
    """The positions (6,) of the joints, in radians."""
    return np.array([-1.0, 0.3, -0.35, 0.2, -0.3, 0.3]) + 0.09 * step * np.array([0.5, 1, -0.3, 0.5, -1, 0.4])


def links(angles: NDArray[np.float64]) -> list[Pose]:
    """The poses (4, 4) of the links' middles in the camera frame."""
    T, found, half_way = moved(np.eye(4), [*SHOULDER_M, 0, 0, 0]), [], [0, 0, HALF_M[2], 0, 0, 0]
    for axis, angle in zip(AXES, angles, strict=True):
        found.append(moved(moved(T, [0, 0, 0, *(angle * axis)]), half_way))
        T = moved(found[-1], half_way)
    return found


def to_arm_m(points_m: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The distance (N,) of points (N, 3) of the camera frame to the arm, negative inside of it."""
    return np.min([to_box_m(points_m, T, HALF_M) for T in links(angles)], axis=0)


def inside_the_arm(angles: NDArray[np.float64], rng: np.random.Generator, many: int) -> NDArray[np.float64]:
    """Points (N, 3) of the camera frame in the arm's links."""
    T = np.array(links(angles))
    local = rng.uniform(-HALF_M, HALF_M, (many, 3))
    return (np.einsum("kij,nj->kni", T[:, :3, :3], local) + T[:, None, :3, 3]).reshape(-1, 3)


def frames(steps: int) -> tuple[list[Frame], list[Frame]]:
    """A camera that goes along a wall with a rod before it; and the same with the arm before the camera."""
    camera, bare, armed = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5), [], []
    for step in range(steps):
        T_world_camera = moved(np.eye(4), [0.02 * step - 0.1, 0.01 * step, 0, 0, 0, 0])
        T_camera_world = inverse(T_world_camera)
        wall = box_depth_m(camera, T_camera_world @ T_WORLD_WALL, WALL_HALF_M)
        rod = box_depth_m(camera, T_camera_world @ T_WORLD_ROD, ROD_HALF_M)
        arm = np.min([box_depth_m(camera, T, HALF_M) for T in links(angles_at(step))], axis=0)
        for each, depth_m in ((bare, np.minimum(wall, rod)), (armed, np.min([wall, rod, arm], axis=0))):
            each.append(Frame(depth_m.astype(np.float32), T_world_camera, camera, float(step), f"{step}"))
    return bare, armed


def write_robot(folder: Path, steps: int) -> dict[str, str]:
    """The URDF and the table of joints, as fields of OwnBody."""
    size = " ".join(f"{2 * half:g}" for half in HALF_M)
    parts, parent, origin = ['<link name="optical"/>'], "optical", SHOULDER_M
    for i, axis in enumerate(AXES):
        parts.append(
            f'<link name="link{i}"><visual><origin xyz="0 0 {HALF_M[2]}"/><geometry><box size="{size}"/>'
            f'</geometry></visual></link><joint name="joint{i}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link{i}"/><origin xyz="{" ".join(map(str, origin))}"/>'
            f'<axis xyz="{" ".join(map(str, axis))}"/>'
            '<limit lower="-4" upper="4" effort="1" velocity="1"/></joint>'
        )
        parent, origin = f"link{i}", np.array([0, 0, 2 * HALF_M[2]])
    (folder / "six.urdf").write_text(f'<robot name="six">{"".join(parts)}</robot>')
    rows = [",".join(map(str, [step, *angles_at(step)])) for step in range(steps)]
    (folder / "joints.csv").write_text(
        "\n".join([",".join(["stamp", *(f"joint{i}" for i in range(6))]), *rows])
    )
    names = {"robot": str(folder / "six.urdf"), "joints": str(folder / "joints.csv")}
    return {**names, "camera_link": "optical"}


pytest.importorskip("yourdfpy")
pytest.importorskip("embreex")
pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.usefixtures("one_backend")]
STEPS, VOXEL_M, FINE_M, MARGIN_M = 12, 0.03, 0.02, 0.02
BARE, ARMED = frames(STEPS)


def seen(folder: Path, frames: list[Frame] = ARMED, **more: str) -> list[Frame]:
    body = OwnBody(**write_robot(folder, STEPS), **more)
    return list(without_body(of_frames(frames), body, AS_USUAL))


def mapped(frames: list[Frame], voxel_m: float = VOXEL_M) -> tm.MRFMap:
    m = tm.MRFMap(voxel_size=voxel_m)
    for frame in frames:
        m.add(frame)
    m.infer()
    return m


def in_the_arm(step: int) -> NDArray[np.float64]:
    """Points (N, 3) of the world in the arm."""
    T = ARMED[step].T_world_camera
    points = inside_the_arm(angles_at(step), np.random.default_rng(step), 200)
    return points @ T[:3, :3].T + T[:3, 3]


def along_the_rod() -> NDArray[np.float64]:
    """Points (N, 3) of the world just behind its front."""
    front = T_WORLD_ROD[:3, 3] - [0, 0, ROD_HALF_M[2] - 0.002]
    return front + np.linspace(-0.25, 0.25, 100)[:, None] * [0, 1, 0]


@pytest.mark.parametrize("step", [5, 8, 11])
def test_a_ray_is_free_up_to_where_it_leaves_the_arm(tmp_path: Path, step: int) -> None:
    """Its last point lies in a link, or within the margin of one, at the arm's angles of that step."""
    frame = seen(tmp_path)[step]
    assert frame.no_return is not None
    free_m = frame.no_return
    assert (free_m >= 0).all()
    assert (free_m > 0).sum() > 1500
    assert not frame.depth_m[free_m > 0].any()
    assert (free_m <= 0)[ARMED[step].depth_m == BARE[step].depth_m].all()
    ends = (frame.camera.rays() * (free_m + MARGIN_M)[..., None])[free_m > 0]
    off = to_arm_m(ends.astype(np.float64), angles_at(step))
    assert np.abs(off).max() < 0.04  # where the ray leaves one link in another
    assert np.quantile(off, 0.9) < 1e-3


@pytest.mark.parametrize("step", [5, 8])
def test_the_space_of_the_arm_is_free_where_it_would_be_unknown(tmp_path: Path, step: int) -> None:
    """Of one image, so that nothing else looks there; near the rod there are voxels, whose states differ."""
    points = in_the_arm(step)
    unknown = mapped([seen(tmp_path, body_space="unknown")[step]]).state(points)
    free = mapped([seen(tmp_path)[step]]).state(points)
    assert (np.asarray(unknown) == tm.UNKNOWN).mean() > 0.2
    assert (np.asarray(free) == tm.FREE).mean() > 0.95
    for states in (unknown, free):
        assert not (np.asarray(states) == tm.OCCUPIED).any()


def test_nothing_of_the_arm_and_all_of_the_rod_is_in_the_map(tmp_path: Path) -> None:
    plain, smeared = mapped(BARE, FINE_M), mapped(ARMED, FINE_M)
    points = np.concatenate([in_the_arm(step) for step in range(STEPS)])
    assert (np.asarray(smeared.state(points)) == tm.OCCUPIED).mean() > 0.02
    rod = np.asarray(plain.state(along_the_rod())) == tm.OCCUPIED
    assert rod.mean() > 0.8
    found = []
    for space in ("unknown", "free"):
        m = mapped(seen(tmp_path, body_space=space), FINE_M)
        assert not (np.asarray(m.state(points)) == tm.OCCUPIED).any()
        found.append((np.asarray(m.state(along_the_rod())) == tm.OCCUPIED)[rod].mean())
    assert found[1] >= found[0] > 0.8  # the arm hides it in some images


def test_edits_are_exact_and_files_keep_it(tmp_path: Path) -> None:
    frames = seen(tmp_path)
    m, poses = mapped(frames), [frame.T_world_camera for frame in frames]
    m.save(tmp_path / "map.npz")
    turned = poses[7].copy()
    turned[:3, 3] += [0.01, 0.02, -0.03]
    anew = tm.MRFMap(voxel_size=VOXEL_M)
    for index, frame in reversed(list(enumerate(frames))):
        if index != 3:
            pose = turned if index == 7 else frame.T_world_camera
            anew.add_keyframe(frame.depth_m, pose, frame.camera, frame.name, no_return=frame.no_return)
    anew.infer()
    for edited in (m, tm.load_map(tmp_path / "map.npz")):
        ids = list(edited.keyframes)
        edited.remove_keyframe(ids[3])
        edited.move_keyframe(ids[7], turned)
        edited.infer()
        assert marginals(edited) == marginals(anew)


def test_a_map_of_scans_takes_no_notice(tmp_path: Path) -> None:
    frames, m = seen(tmp_path), tm.LogOddsMap(voxel_size=VOXEL_M)
    m.add(frames[8])
    (keyframe,) = m.keyframes.values()
    assert keyframe.own.no_return is None
