"""The answers of the intake: what it says to each kind of frame, and what is left of the map then."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from sliding_camera import ALL_FRAMES, sequence
from tracked_room import CONFIG, nowhere, walk

from taichi_mrf.config.schema import KeyframeConfig, PoseConfig
from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.mapping.intake import Added, Full, Intake, Lost, Passed, Skipped, UnreadableFrame
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.queries.points import FREE
from taichi_mrf.sensor.pose_doubt import covariance_of

pytestmark = pytest.mark.usefixtures("one_backend")


def intake(hold_out: int = 0) -> Intake:
    config = replace(ALL_FRAMES, keyframes=KeyframeConfig(translation=0.15))
    return Intake(MRFMap.from_config(config, sequence().camera), config, hold_out=hold_out)


def test_each_frame_gets_the_answer_that_fits_it() -> None:
    taken = intake()
    frames = sequence(4, blind=[3])
    first = taken.offer(frames.read(0), 1, 0)
    assert isinstance(first, Added)
    assert (first.frame.name, first.keyframe, first.rays) == ("frame 0", 0, 32 * 24)
    near, far, blind = (taken.offer(frames.read(index)) for index in (1, 2, 3))
    assert isinstance(near, Passed)
    assert near.reason == "too near to a keyframe"
    assert isinstance(far, Added)
    assert isinstance(blind, Passed)
    broken = taken.offer(UnreadableFrame("frame 9", "frame 9: damaged"))
    assert broken == Skipped("frame 9: damaged")
    assert taken.result.skipped == {"frame 9": "frame 9: damaged"}
    assert list(taken.map.keyframes) == [0, 1]


def test_keyframes_get_the_covariance_of_the_configuration() -> None:
    doubtful = replace(ALL_FRAMES, poses=PoseConfig(doubt_translation=0.02, doubt_rotation=0.01))
    for config, expected in ((ALL_FRAMES, None), (doubtful, covariance_of(0.02, 0.01))):
        taken = Intake(MRFMap.from_config(config, sequence().camera), config)
        taken.offer(sequence().read(0))
        covariance = taken.map.keyframes[0].own.pose_covariance
        assert (covariance is None) == (expected is None)
        if covariance is not None:
            np.testing.assert_array_equal(covariance, expected)
    with pytest.raises(ConfigError, match=r"poses\.doubt_rotation must be finite and not negative"):
        PoseConfig(doubt_rotation=-0.1)


def test_held_out_frames_are_not_even_read_where_poses_are_recorded() -> None:
    taken = intake(hold_out=3)
    assert [taken.passes_unread(number, 10 * number) for number in (1, 2, 3, 4, 5)] == [
        False,
        True,
        False,
        False,
        True,
    ]
    assert taken.result.held_out == [20, 50]


def test_a_frame_without_memory_leaves_the_map_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = intake()
    taken.offer(sequence().read(0))
    swept: list[int] = []

    def sweep(keyframe: int) -> None:
        swept.append(keyframe)
        raise CapacityError("no memory")

    monkeypatch.setattr(taken, "_sweep", sweep)
    answer = taken.offer(sequence().read(2))
    assert isinstance(answer, Full)
    assert answer.problem == "frame frame 2 does not fit: no memory"
    assert swept == [1]
    assert list(taken.map.keyframes) == [0]
    monkeypatch.undo()
    assert isinstance(taken.offer(sequence().read(2)), Added), "it was not selected by mistake"


def test_lost_frames_are_counted_in_a_row() -> None:
    dataset = walk(range(4), {2: nowhere(), 3: nowhere()})
    taken = Intake(MRFMap.from_config(CONFIG, dataset.camera), CONFIG, tracked=True)
    answers = [taken.offer(dataset.read(index), index + 1, index) for index in range(4)]
    assert isinstance(answers[0], Added)
    lost = [answer.in_a_row for answer in answers if isinstance(answer, Lost)]
    assert lost == [1, 2]
    assert taken.result.track is not None
    assert (list(taken.result.track.frames), taken.result.track.lost) == ([0, 1], 2)
    assert np.isfinite(taken.result.track.frames[1].T_world_camera).all()


def test_frames_that_do_not_name_pixels_without_a_return_are_reported_once() -> None:
    config = replace(ALL_FRAMES, sensor=replace(ALL_FRAMES.sensor, no_return="model"))
    taken = Intake(MRFMap.from_config(config, sequence().camera), config)
    frames = [sequence().read(index) for index in range(3)]
    named = replace(frames[0], no_return=frames[0].depth_m > 2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert isinstance(taken.offer(named), Added)
    with pytest.warns(UserWarning, match="frame 1 does not mark pixels without a return"):
        taken.offer(frames[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        taken.offer(frames[2])


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_a_frame_of_missing_returns_alone_frees_space_where_they_count(method: str) -> None:
    frame = sequence().read(0)
    nothing, everywhere = np.zeros_like(frame.depth_m), np.ones(frame.depth_m.shape, bool)
    frame = replace(frame, depth_m=nothing, no_return=everywhere)
    sensor = replace(ALL_FRAMES.sensor, no_return="free", no_return_depth=2.0)
    config = replace(ALL_FRAMES, method=method)
    answer = Intake(create_map(config, frame.camera), config).offer(frame)
    assert isinstance(answer, Passed)
    assert answer.reason == "no pixel holds a measurement"
    config = replace(config, sensor=sensor)
    m = create_map(config, frame.camera)
    assert isinstance(Intake(m, config).offer(frame), Added)
    m.infer()
    ways = frame.camera.rays()[::10, ::10].reshape(-1, 3) @ frame.T_world_camera[:3, :3].T
    assert (m.state(frame.T_world_camera[:3, 3] + 1.5 * ways) == FREE).all()
