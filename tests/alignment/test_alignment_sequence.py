"""Refining all poses of a sequence: alignment of all at once, and the pipeline."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from inputs_frames import Frames, of_frames
from tracked_room import coarse_frames, disturbed

from taichi_mrf.alignment.joint import align_jointly
from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.alignment.recorded import RecordedPoses
from taichi_mrf.config.schema import Config, EvaluationConfig, PoseConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.inference.schedule import InferProgress, driven
from taichi_mrf.mapping import rounds
from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import Event, FrameOffered, map_sequence
from taichi_mrf.mapping.rounds import RoundStep
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("one_backend")

COUNT = 8
REFINE = Config(voxel_size=0.1, poses=PoseConfig(refine=True), evaluation=EvaluationConfig(hold_out=0))


def posed(poses: Sequence[Pose]) -> Frames:
    """The room with the poses of a bad tracker."""
    return of_frames([replace(f, T_world_camera=T) for f, T in zip(coarse_frames(), poses, strict=True)])


def errors(poses: Sequence[Pose]) -> np.ndarray:
    """Mean rotation (radians) and translation (metres) off the truth; the first is no error at all."""
    true = [frame.T_world_camera for frame in coarse_frames()]
    each = [tangent_norms(a, b) for a, b in zip(true, poses, strict=True)]
    assert np.array_equal(poses[0], true[0])
    return np.mean(each[1:], axis=0)


def recorded(poses: dict[int, Pose], config: PoseConfig | None = None) -> RecordedPoses:
    return RecordedPoses([poses[id] for id in sorted(poses)], config or PoseConfig())


def test_all_at_once_takes_back_more_than_half() -> None:
    points = {
        i: oriented_points(DepthImage.upload(f.depth_m, f.camera, PolynomialNoise((0.003,))), 10.0)
        for i, f in enumerate(coarse_frames())
    }
    start = dict(enumerate(disturbed(COUNT, 0)))
    found = driven(align_jointly(points, start, recorded(start)))
    before, after = errors(list(start.values())), errors(list(found.values()))
    assert (after < 0.5 * before).all()


def test_poses_recorded_well_are_trusted() -> None:
    points = {
        i: oriented_points(DepthImage.upload(f.depth_m, f.camera, PolynomialNoise((0.003,))), 10.0)
        for i, f in enumerate(coarse_frames()[:3])
    }
    start = dict(enumerate(disturbed(COUNT, 0)[:3]))
    sure = PoseConfig(translation_sigma=1e-5, rotation_sigma=1e-5)
    found = driven(align_jointly(points, start, recorded(start, sure)))
    for id, T in found.items():
        np.testing.assert_allclose(T, start[id], atol=1e-4)


def test_a_keyframe_without_partners_stays_where_it_was_recorded() -> None:
    frames = [coarse_frames()[i] for i in (0, 1)]
    points = {
        i: oriented_points(DepthImage.upload(f.depth_m, f.camera, PolynomialNoise((0.003,))), 10.0)
        for i, f in enumerate(frames)
    }
    away = frames[1].T_world_camera.copy()
    away[:3, 3] += 30.0
    poses = {0: frames[0].T_world_camera, 1: away}
    np.testing.assert_allclose(driven(align_jointly(points, poses, recorded(poses)))[1], away, atol=1e-9)


def test_the_pipeline_corrects_poses_and_tells_both() -> None:
    events: list[Event] = []
    wrong = disturbed(COUNT, 1)
    result = map_sequence(posed(wrong), REFINE, events.append)
    assert isinstance(result.map, MRFMap)
    assert [change.name for change in result.poses] == [frame.name for frame in coarse_frames()]
    for change, T_recorded in zip(result.poses, wrong, strict=True):
        np.testing.assert_array_equal(change.T_recorded, T_recorded)
        np.testing.assert_array_equal(change.T_refined, result.map.keyframes[change.keyframe].T_world_camera)
        assert (change.rotation_rad, change.translation_m) == tangent_norms(T_recorded, change.T_refined)
    refined = [change.T_refined for change in result.poses]
    assert (errors(refined) < 0.5 * errors(wrong)).all()
    assert "refining" in result.seconds
    kinds = [type(event) for event in events]
    assert kinds.index(FrameOffered) < kinds.index(RoundStep) < kinds.index(InferProgress)
    asked = [(e.round, e.rounds, e.moved, e.keyframes) for e in events if isinstance(e, RoundStep)]
    made = asked[-1][0]
    steps = [(round, number) for round in range(1, made + 1) for number in range(1, COUNT + 1)]
    assert asked == [(round, rounds.MOST_ROUNDS, number, COUNT) for round, number in steps]
    # The map is that of the refined poses, whatever was done on the way.
    again = MRFMap.from_config(result.map.config, result.map.keyframes[0].camera)
    for frame, T in zip(coarse_frames(), refined, strict=True):
        again.add_keyframe(frame.depth_m, T, frame.camera)
    again.infer()
    centres, _ = again.voxels(min_probability=0.0)
    np.testing.assert_array_equal(result.map.occupancy(centres), again.occupancy(centres))


def test_a_stopped_run_goes_on_with_the_recorded_poses_of_its_keyframes() -> None:
    wrong = disturbed(COUNT, 2)
    left = [3]

    def listen(event: Event) -> None:
        left[0] -= isinstance(event, FrameOffered) and isinstance(event.answer, Added)

    part = map_sequence(posed(wrong), REFINE, listen, should_stop=lambda: left[0] <= 0)
    assert part.interrupted
    assert len(part.poses) == 3
    whole = map_sequence(posed(wrong), REFINE, resume_from=part.map)
    assert len(whole.poses) == COUNT
    for change, T_recorded in zip(whole.poses, wrong, strict=True):
        np.testing.assert_array_equal(change.T_recorded, T_recorded)
    assert (errors([change.T_refined for change in whole.poses]) < 0.5 * errors(wrong)).all()


def test_a_stop_in_the_rounds_undoes_the_round(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = disturbed(COUNT, 1)
    told: list[Event] = []

    def stop() -> bool:
        return any(isinstance(event, RoundStep) and event.moved == 3 for event in told)

    stopped = map_sequence(posed(wrong), REFINE, told.append, should_stop=stop)
    assert stopped.interrupted
    assert stopped.sweeps == 1
    monkeypatch.setattr(rounds, "MOST_ROUNDS", 0)
    as_added = map_sequence(posed(wrong), REFINE)
    for change, expected in zip(stopped.poses, as_added.poses, strict=True):
        np.testing.assert_array_equal(change.T_refined, expected.T_refined)


def test_without_it_nothing_is_moved() -> None:
    wrong = disturbed(COUNT, 1)
    result = map_sequence(posed(wrong), replace(REFINE, poses=PoseConfig()), limit=2)
    assert result.poses == []
    for keyframe, T in zip(result.map.keyframes.values(), wrong, strict=False):
        np.testing.assert_array_equal(keyframe.T_world_camera, T)


def test_only_mrf_maps_can_move_keyframes() -> None:
    with pytest.raises(ConfigError, match=r"poses.refine needs the method mrf"):
        map_sequence(posed(disturbed(COUNT, 1)), replace(REFINE, method="log_odds"))
