"""--body-space: where an arm of six joints was, there was nothing of the world; and what is near it stays."""

from pathlib import Path

import numpy as np
import pytest
import six_joints as six
from inputs_frames import of_frames
from live_scene import marginals
from numpy.typing import NDArray

import taichi_mrf as tm
from taichi_mrf.datasets.conventions import AS_USUAL
from taichi_mrf.datasets.own_body import OwnBody
from taichi_mrf.datasets.without_body import without_body
from taichi_mrf.sensor.frame import Frame

pytest.importorskip("yourdfpy")
pytest.importorskip("embreex")
pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.usefixtures("one_backend")]
STEPS, VOXEL_M, FINE_M, MARGIN_M = 12, 0.03, 0.02, 0.02
BARE, ARMED = six.frames(STEPS)


def seen(folder: Path, frames: list[Frame] = ARMED, **more: str) -> list[Frame]:
    body = OwnBody(**six.write_robot(folder, STEPS), **more)
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
    points = six.inside_the_arm(six.angles_at(step), np.random.default_rng(step), 200)
    return points @ T[:3, :3].T + T[:3, 3]


def along_the_rod() -> NDArray[np.float64]:
    """Points (N, 3) of the world just behind its front."""
    front = six.T_WORLD_ROD[:3, 3] - [0, 0, six.ROD_HALF_M[2] - 0.002]
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
    off = six.to_arm_m(ends.astype(np.float64), six.angles_at(step))
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
