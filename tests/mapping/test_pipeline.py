"""From frames to a map: which frames are taken, what listeners hear, stopping and going on."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_camera import ALL_FRAMES, CAMERA, WALL_M, SlidingCamera, StopAfter, names, sequence

from taichi_mrf.config.schema import EvaluationConfig, KeyframeConfig, SensorConfig
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.evaluation.held_out import check_held_out
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.intake import Added, Passed, Skipped
from taichi_mrf.mapping.pipeline import (
    Event,
    FrameOffered,
    map_sequence,
)
from taichi_mrf.methods.mrf.map import MRFMap

pytestmark = pytest.mark.usefixtures("one_backend")


def marginals(m: MRFMap) -> dict[tuple[float, ...], float]:
    centres, probability = m.marginals.voxels(min_probability=0.0)
    return {tuple(np.round(c, 4)): float(p) for c, p in zip(centres, probability, strict=True)}


def test_all_frames_become_keyframes_and_the_wall_is_where_it_is() -> None:
    result = map_sequence(sequence(), ALL_FRAMES)
    assert names(result.map) == [f"frame {k}" for k in range(6)]
    assert result.frames == 6
    assert result.sweeps == ALL_FRAMES.inference.sweeps
    assert not result.interrupted
    rendered = result.map.render_depth(CAMERA, sequence().read(2).T_world_camera)
    assert abs(float(np.nanmedian(rendered)) - WALL_M) < ALL_FRAMES.voxel_size
    assert {"reading", "adding", "inferring"} <= result.seconds.keys()


def test_every_and_limit_choose_the_frames() -> None:
    assert names(map_sequence(sequence(8), ALL_FRAMES, every=3).map) == ["frame 0", "frame 3", "frame 6"]
    assert names(map_sequence(sequence(8), ALL_FRAMES, every=2, limit=2).map) == ["frame 0", "frame 2"]


def test_thresholds_choose_the_keyframes() -> None:
    config = replace(ALL_FRAMES, keyframes=KeyframeConfig(translation=0.15))
    assert names(map_sequence(sequence(), config).map) == ["frame 0", "frame 2", "frame 4"]


def test_held_out_frames_are_not_mapped_and_check_the_map() -> None:
    config = replace(ALL_FRAMES, evaluation=EvaluationConfig(hold_out=3))
    result = map_sequence(sequence(7), config)
    assert result.held_out == [1, 4]
    assert names(result.map) == [f"frame {k}" for k in (0, 2, 3, 5, 6)]
    heard: list[int] = []
    check = check_held_out(result.map, sequence(7), result.held_out, heard.append)
    assert heard == [1, 2]
    assert check.frames == 2
    assert check.error.pixels > 0
    assert check.error.median_abs < config.voxel_size


def test_the_bias_of_the_sensor_is_no_error_of_the_map() -> None:
    """The wall is 20 cm nearer than it was measured, as the map knows."""
    sensor = SensorConfig(bias=(0.0, 2 / 13))
    config = replace(ALL_FRAMES, sensor=sensor, evaluation=EvaluationConfig(hold_out=3))
    result = map_sequence(sequence(7), config)
    check = check_held_out(result.map, sequence(7), result.held_out)
    assert check.error.median_abs < config.voxel_size
    rendered = result.map.render_depth(CAMERA, sequence(7).read(4).T_world_camera)
    assert abs(float(np.nanmedian(rendered)) - 1.3) < config.voxel_size


def test_a_broken_held_out_frame_is_named_and_the_others_count() -> None:
    result = map_sequence(sequence(7), replace(ALL_FRAMES, evaluation=EvaluationConfig(hold_out=3)))
    check = check_held_out(result.map, sequence(7, broken=[4]), result.held_out, keep=[1, 4])
    assert check.frames == 1
    frame, rendered_m = check.kept.pop(1)
    np.testing.assert_array_equal(rendered_m, result.map.render_depth(frame.camera, frame.T_world_camera))
    assert not check.kept
    assert check.skipped == {"frame 4": "frame 4: the image is damaged"}


def test_listeners_hear_every_frame_and_every_swept_keyframe() -> None:
    events: list[Event] = []
    config = replace(ALL_FRAMES, evaluation=EvaluationConfig(hold_out=4))
    result = map_sequence(sequence(5, broken=[3], blind=[4]), config, events.append, skip_bad_frames=True)
    frames = [event for event in events if isinstance(event, FrameOffered)]
    assert [event.number for event in frames] == [1, 2, 3, 4, 5]
    assert [type(event.answer) for event in frames] == [Added, Added, Passed, Skipped, Passed]
    added = [event.answer for event in frames if isinstance(event.answer, Added)]
    assert [answer.keyframe for answer in added] == list(result.map.keyframes)
    assert all(answer.rays == CAMERA.width * CAMERA.height for answer in added)
    swept = [(e.sweep, e.keyframe, e.keyframes) for e in events if isinstance(e, InferProgress)]
    assert swept == [(sweep, number, 2) for sweep in (1, 2, 3) for number in (1, 2)]


def test_a_broken_frame_ends_the_run_or_is_reported() -> None:
    with pytest.raises(FrameError, match="frame 3: the image is damaged"):
        map_sequence(sequence(broken=[3]), ALL_FRAMES)
    result = map_sequence(sequence(broken=[3]), ALL_FRAMES, skip_bad_frames=True)
    assert result.skipped == {"frame 3": "frame 3: the image is damaged"}
    assert "frame 3" not in names(result.map)


@pytest.mark.parametrize(
    ("dataset", "words"),
    [
        (sequence(0), "contains no frame to map"),
        (sequence(2, broken=[0, 1]), "2 could not be used, the first: frame 0: the image is damaged"),
        (sequence(2, blind=[0, 1]), "contains no frame to map"),
    ],
)
def test_a_map_without_keyframes_is_an_error(dataset: SlidingCamera, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        map_sequence(dataset, ALL_FRAMES, skip_bad_frames=True)


def test_a_stop_while_adding_leaves_a_usable_map() -> None:
    stop = StopAfter(Added, 2)
    result = map_sequence(sequence(), ALL_FRAMES, stop.listen, should_stop=stop)
    assert result.interrupted
    assert names(result.map) == ["frame 0", "frame 1"]
    assert result.sweeps == 1
    assert len(result.map.voxels(min_probability=0.5)[0]) > 0


def test_a_stop_in_the_first_sweep_still_hears_every_keyframe() -> None:
    events: list[Event] = []
    stop = StopAfter(InferProgress, 1)

    def listen(event: Event) -> None:
        events.append(event)
        stop.listen(event)

    result = map_sequence(sequence(), ALL_FRAMES, listen, should_stop=stop)
    assert result.interrupted
    assert [(e.sweep, e.keyframe) for e in events if isinstance(e, InferProgress)] == [
        (1, number) for number in range(1, 7)
    ]


def test_a_stop_in_a_later_sweep_ends_at_the_next_keyframe() -> None:
    stop = StopAfter(InferProgress, 8)
    result = map_sequence(sequence(), ALL_FRAMES, stop.listen, should_stop=stop)
    assert result.interrupted
    assert stop.left == 0
    assert result.sweeps == 2


def test_a_stop_before_the_first_keyframe_is_an_error() -> None:
    with pytest.raises(DatasetError, match="stopped before the first keyframe"):
        map_sequence(sequence(), ALL_FRAMES, should_stop=lambda: True)


@pytest.mark.parametrize("stop_after", [1, 3, 5])
def test_a_resumed_run_ends_in_the_map_of_an_undisturbed_one(stop_after: int) -> None:
    config = replace(
        ALL_FRAMES,
        keyframes=KeyframeConfig(translation=0.15),
        evaluation=EvaluationConfig(hold_out=5),
    )
    whole = map_sequence(sequence(12), config)
    stop = StopAfter(Added, stop_after)
    part = map_sequence(sequence(12), config, stop.listen, should_stop=stop)
    assert len(part.map.keyframes) == stop_after
    resumed = map_sequence(sequence(12), config, resume_from=part.map)
    assert names(resumed.map) == names(whole.map)
    assert resumed.held_out == whole.held_out
    expected, got = marginals(whole.map), marginals(resumed.map)
    assert got.keys() == expected.keys()
    assert max(abs(got[key] - expected[key]) for key in expected) < 1e-3


def test_a_map_of_another_recording_is_not_resumed() -> None:
    part = map_sequence(sequence(4), ALL_FRAMES)
    other = replace(sequence(2), name="other")
    with pytest.raises(DatasetError, match="keyframe 'frame 2' is not in other"):
        map_sequence(other, ALL_FRAMES, resume_from=part.map)
