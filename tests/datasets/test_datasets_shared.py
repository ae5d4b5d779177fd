"""The real recordings open with all their frames, and their views agree with each other."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.formats.numbered_depth import ICL_NUIM
from taichi_mrf.datasets.options import PRIMESENSE
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

pytestmark = pytest.mark.shared_data

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


@pytest.mark.parametrize("name", RECORDINGS)
def test_all_frames_open(shared_data: Path, name: str) -> None:
    count, camera = RECORDINGS[name]
    dataset = open_dataset(shared_data / name)
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
        assert (frame.color is not None) == (name == "seven_scenes_redkitchen")


def test_only_read_intrinsics_go_without_a_note(shared_data: Path) -> None:
    for name in RECORDINGS:
        notes = open_dataset(shared_data / name).notes
        assert any("assumed" in note for note in notes) == (name != "seven_scenes_redkitchen")


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


@pytest.mark.parametrize(
    ("name", "wrong", "apart"),
    [("icl_nuim_livingroom_traj2", PRIMESENSE, 4), ("house_livingroom", ICL_NUIM, 1)],
)
def test_the_assumed_camera_fits_better_than_the_other(
    shared_data: Path, name: str, wrong: PinholeCamera, apart: int
) -> None:
    folder = shared_data / name
    assert median_disagreement(folder, apart=apart) < 0.7 * median_disagreement(folder, wrong, apart)


def test_the_data_folder_itself_names_its_recordings(shared_data: Path) -> None:
    refused(shared_data, "seven_scenes_redkitchen")
