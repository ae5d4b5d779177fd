"""When frames are due: by their stamps and the speed, in order, without those that are kept out."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.mapping.intake import UnreadableFrame
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.run import Progress

CAMERA = PinholeCamera(width=4, height=3, fx=4.0, fy=4.0, cx=1.5, cy=1.0)


@dataclass
class Recording(Dataset):
    """Frames with given stamps; those in ``broken`` cannot be read, those in ``wrong`` meet a defect, and
    after ``lost`` frames the source is gone."""

    stamps: Sequence[float] = ()
    broken: Sequence[int] = ()
    wrong: Sequence[int] = ()
    lost: int | None = None

    @property
    def frame_names(self) -> Sequence[str]:
        return [f"{index}" for index in range(len(self.stamps))]

    def read(self, index: int) -> Frame:
        if self.lost is not None and index >= self.lost:
            raise DatasetError("the camera is gone")
        if index in self.broken:
            raise FrameError(f"{index}: broken")
        if index in self.wrong:
            raise ZeroDivisionError("a defect")
        return Frame(np.ones(CAMERA.shape, np.float32), np.eye(4), CAMERA, self.stamps[index], f"{index}")


class Camera(Recording):
    """A source without an end."""

    endless = True


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def recording(*stamps: float, **options: object) -> Recording:
    return Recording("recording", CAMERA, stamps=stamps, **options)


def begun(*stamps: float, **options: object) -> tuple[Replay, Clock]:
    """A replay at its own pace whose first frame is taken, and its clock."""
    clock = Clock()
    replay = Replay(recording(*stamps, **options), speed=1.0, clock=clock)
    assert replay.due_in() == 0.0
    assert isinstance(replay.take(), Frame)
    return replay, clock


def taken(replay: Replay, most: int = 100) -> list[str]:
    """The names of the frames up to the end."""
    frames = []
    while len(frames) < most and (frame := replay.take()) is not None:
        frames.append(frame.name if isinstance(frame, Frame) else frame.problem)
    return frames


@given(
    st.integers(0, 20),
    st.integers(1, 4),
    st.one_of(st.none(), st.integers(1, 10)),
    st.sampled_from([0, 2, 3, 10]),
)
def test_the_frames_are_those_that_map_sequence_takes(
    count: int, every: int, limit: int | None, hold_out: int
) -> None:
    replay = Replay(recording(*range(count)), every=every, limit=limit, hold_out=hold_out)
    indices = range(0, count, every)[:limit]
    expected = [f"{index}" for n, index in enumerate(indices, start=1) if not is_held_out(n, hold_out)]
    assert replay.frames == len(indices)
    assert taken(replay) == expected
    assert replay.finished
    assert replay.due_in() is None


def test_at_its_own_pace_a_frame_is_due_when_its_stamp_says() -> None:
    clock = Clock()
    replay = Replay(recording(5.0, 5.5, 7.0), speed=1.0, clock=clock)
    for wait in (0.0, 0.5, 1.5):
        assert replay.due_in() == pytest.approx(wait)
        clock.now += wait
        assert replay.due_in() == 0.0
        assert replay.take() is not None
    assert replay.finished


@given(st.floats(0.01, 100.0))
def test_twice_the_speed_is_half_the_wait(speed: float) -> None:
    replay = Replay(recording(0.0, 3.0), speed=speed, clock=Clock())
    assert replay.due_in() == 0.0
    replay.take()
    assert replay.due_in() == pytest.approx(3.0 / speed)


def test_as_fast_as_possible_reads_nothing_ahead() -> None:
    replay = Replay(recording(0.0, 1e9, broken=[0]))
    assert replay.due_in() == 0.0
    assert replay.take() == UnreadableFrame("0", "0: broken")
    assert replay.due_in() == 0.0


def test_mapping_that_is_too_slow_does_not_wait() -> None:
    replay, clock = begun(0.0, 1.0, 2.0)
    clock.now += 10.0
    assert replay.due_in() == 0.0
    replay.take()
    assert replay.due_in() == 0.0


def test_the_time_in_a_pause_does_not_count() -> None:
    replay, clock = begun(0.0, 1.0, 2.0)
    replay.pause()
    assert replay.due_in() is None
    clock.now += 50.0
    replay.resume()
    assert replay.due_in() == 0.0
    replay.take()
    assert replay.due_in() == pytest.approx(1.0)


def test_while_paused_frames_can_be_taken_one_by_one() -> None:
    replay = Replay(recording(0.0, 1.0), speed=1.0)
    replay.pause()
    assert taken(replay) == ["0", "1"]


def test_another_speed_counts_from_now() -> None:
    replay, _ = begun(0.0, 8.0, 16.0)
    replay.set_speed(0.0)
    assert replay.due_in() == 0.0
    replay.set_speed(2.0)
    assert replay.due_in() == 0.0  # the next begins the new count
    replay.take()
    assert replay.due_in() == pytest.approx(4.0)


@pytest.mark.parametrize("speed", [-1.0, math.nan, math.inf])
def test_what_is_no_speed_is_refused(speed: float) -> None:
    replay = Replay(recording(0.0), speed=3.0)
    with pytest.raises(ConfigError, match="speed"):
        replay.set_speed(speed)
    assert replay.speed == 3.0


@pytest.mark.parametrize(
    ("source", "has_pace"),
    [
        (recording(0.0, 1.0), True),
        (recording(math.nan, math.nan), False),
        (Camera("camera", CAMERA, stamps=(0.0, 1.0)), False),
    ],
    ids=["stamps", "no stamps", "camera"],
)
def test_frames_of_a_camera_and_without_stamps_have_no_pace(source: Recording, has_pace: bool) -> None:
    replay = Replay(source)
    replay.take()
    assert replay.has_pace is has_pace


def test_broken_frames_come_in_their_place_and_at_once() -> None:
    replay, _ = begun(0.0, 9.0, 18.0, 27.0, broken=[1], wrong=[2])
    assert replay.due_in() == 0.0
    assert replay.take() == UnreadableFrame("1", "1: broken")
    assert replay.take() == UnreadableFrame("2", "2: cannot be read: a defect")
    assert isinstance(replay.take(), Frame)
    assert replay.finished


def test_a_stamp_that_is_no_number_is_due_at_once() -> None:
    replay, _ = begun(0.0, math.nan)
    assert replay.due_in() == 0.0


def test_a_loop_begins_again_at_the_first_frame_and_its_pace() -> None:
    clock = Clock()
    replay = Replay(recording(0.0, 1.0), speed=1.0, loop=True, clock=clock)
    names = []
    for wait in itertools.islice(itertools.cycle([0.0, 1.0]), 6):
        assert replay.due_in() == pytest.approx(wait)
        clock.now += wait
        frame = replay.take()
        assert isinstance(frame, Frame)
        names.append(frame.name)
    assert names == ["0", "1"] * 3
    assert not replay.finished


def test_time_goes_on_when_a_loop_begins_again() -> None:
    replay = Replay(recording(10.0, 10.5, 12.5), loop=True)
    frames = [replay.take() for _ in range(8)]
    stamps = [frame.stamp for frame in frames if isinstance(frame, Frame)]
    assert stamps == [10.0, 10.5, 12.5, 14.5, 15.0, 17.0, 19.0, 19.5]


def test_a_loop_over_broken_frames_ends() -> None:
    replay = Replay(recording(0.0, 1.0, broken=[0, 1]), loop=True)
    assert taken(replay) == ["0: broken", "1: broken"]
    assert replay.finished
    assert Replay(recording(), loop=True).finished  # nor one over nothing


@pytest.mark.parametrize("loop", [False, True])
def test_a_source_that_breaks_off_ends_and_says_why(loop: bool) -> None:
    replay = Replay(recording(0.0, 1.0, 2.0, lost=1), loop=loop)
    assert isinstance(replay.take(), Frame)
    assert replay.take() == UnreadableFrame("1", "the camera is gone", last=True)
    assert replay.finished
    assert replay.problem == "the camera is gone"
    assert replay.take() is None


def test_a_camera_sets_its_own_pace_and_has_no_number_of_frames() -> None:
    camera = Camera("camera", CAMERA, stamps=[0.0, 50.0, 99.0], lost=3)
    replay = Replay(camera, speed=1.0, clock=Clock())
    assert replay.frames == 0
    for _ in range(3):
        assert replay.due_in() == 0.0
        assert isinstance(replay.take(), Frame)
        assert not replay.finished
    assert replay.take() == UnreadableFrame("frame 3", "the camera is gone", last=True)
    assert replay.finished


def test_the_number_of_a_cameras_frames_can_be_limited() -> None:
    camera = Camera("camera", CAMERA, stamps=range(100))
    assert taken(Replay(camera, limit=5)) == ["0", "1", "2", "3", "4"]


def test_the_time_left_follows_the_pace_of_the_last_frames() -> None:
    now = [0.0]
    progress = Progress(clock=lambda: now[0])
    replay = Replay(Recording("recording", CAMERA, stamps=range(100)))
    said = []
    for _ in range(12):
        said.append(progress.time_left(replay))
        replay.take()
        now[0] += 0.5
    assert said[2] == ""
    assert said[11] == ", about 45 s left"  # 89 frames, half a second each
    replay.set_speed(1.0)
    for _ in range(60):
        replay.take()
        now[0] += 10.0
        last = progress.time_left(replay)
    assert last == ", about 5 min left"  # what was faster counts no more
