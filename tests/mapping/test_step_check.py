"""Recorded steps that are too short or too long are found by aligning depth, and true ones raise no alarm."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.step_check import StepCheck, check_steps
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.session.report import run_report

pytestmark = pytest.mark.usefixtures("one_backend")

KINECT = PolynomialNoise((0.0012, 0.0, 0.0019))


@cache
def room() -> list[Frame]:
    return list(open_dataset("synthetic:room?width=160&height=120&frames=60", color=False))


def checked(frames: list[Frame], scale: float) -> StepCheck | None:
    poses = {id: frame.T_world_camera.copy() for id, frame in enumerate(frames)}
    for T in poses.values():
        T[:3, 3] *= scale
    return check_steps(dict(enumerate(frames)), poses, KINECT, 10.0)


@pytest.mark.parametrize("scale", [0.93, 1.08])
def test_poses_in_another_scale_are_found_with_the_factor(scale: float) -> None:
    found = checked(room(), scale)
    assert found is not None
    assert found.disagrees
    assert found.ratio == pytest.approx(1 / scale, abs=0.015)


def test_true_poses_agree() -> None:
    found = checked(room(), 1.0)
    assert found is not None
    assert not found.disagrees
    assert found.ratio == pytest.approx(1.0, abs=0.01)


def test_a_few_keyframes_are_not_checked() -> None:
    assert checked(room()[:10], 0.93) is None


def test_a_real_recording_raises_no_alarm(shared_data: Path) -> None:
    dataset = open_dataset(shared_data / "seven_scenes_redkitchen", color=False)
    found = checked([dataset.read(index) for index in range(50)], 1.0)
    assert found is None or not found.disagrees


def test_the_report_says_so() -> None:
    result = MappingResult(MRFMap(0.1), steps=StepCheck(1.075, 0.005, 9))
    report = run_report(result, None, "walk", None)
    assert report["steps"]["aligned_over_recorded"] == 1.075
    assert any("1.075 times as far" in note for note in report["notes"])
    fine = run_report(replace(result, steps=StepCheck(1.01, 0.005, 9)), None, "walk", None)
    assert not fine["notes"]
