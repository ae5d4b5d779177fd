"""The state of a live run: its source, its map, and the connection to its page."""

import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np

from taichi_mrf.config.schema import to_yaml
from taichi_mrf.errors import CapacityError
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.follow import follower_of
from taichi_mrf.mapping.intake import Intake
from taichi_mrf.mapping.onto import place_check_of
from taichi_mrf.mapping.pipeline import keyframes_in
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.methods.capabilities import (
    can_freeze,
    has_messages,
    measures_surface,
    window_of,
)
from taichi_mrf.methods.protocol import MapStatistics
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.files import MAP_FILE
from taichi_mrf.session.folder import RunFacts
from taichi_mrf.session.link import Link
from taichi_mrf.session.mapper import LiveKeyframe, Mapper
from taichi_mrf.session.pictures import outlined
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.session_core import WAIT_SECONDS, Policy, SessionCore
from taichi_mrf.session.shown_extras import lack_of_surface
from taichi_mrf.session.shown_map import ShownMap
from taichi_mrf.session.source import Source, saved_unsettled
from taichi_mrf.viewer.messages import Bricks, CurrentCamera, KeyframeInfo, Notice, Select, Status, TimeSpan

RATE_SECONDS = 5.0
"""Seconds over which the rates of keyframes and of frames are averaged."""


PLAY_STEPS = 60
"""Times from the first keyframe until now at which a map is shown when it is played."""

PACE_SECONDS = 30.0
"""Seconds over which the pace of frames is averaged that the time left is computed from."""

LEAST_FRAMES = 3
"""No time is given before so many frames have been read."""


def in_words(seconds: float) -> str:
    """About how long something takes, in steps that do not flicker."""
    if seconds < 60:
        return f"about {max(5, 5 * round(seconds / 5))} s"
    minutes = round(seconds / 60)
    return f"about {minutes} min" if minutes < 90 else f"about {round(minutes / 60)} h"


class Progress:
    """Makes Status messages."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._taken: deque[float] = deque()
        self._looked_at: deque[float] = deque()
        self._pace: deque[tuple[float, int]] = deque()  # frames that were read by some times
        self._begin = clock()
        self._measured: MapStatistics | None = None

    def keyframe_taken(self) -> None:
        """Count a keyframe for the rate."""
        self._taken.append(self._clock())

    def frame_looked_at(self) -> None:
        """Count a frame for the rate, whether or not it becomes a keyframe."""
        self._looked_at.append(self._clock())

    def measure(self, mapper: Mapper) -> None:
        """Measure the map's size, which takes too long for every message."""
        self._measured = mapper.map.statistics()

    def status(
        self, activity: str, share: float, replay: Replay | None, mapper: Mapper, waiting: bool
    ) -> Status:
        """``waiting``: edits wait until the present work is done."""
        if self._measured is None:
            self.measure(mapper)
        assert self._measured is not None
        on = len(mapper.roster.with_state("on"))
        if replay is not None and not (replay.paused or replay.finished):
            activity += self.time_left(replay)
        return Status(
            activity,
            share,
            replay.number if replay else 0,
            replay.frames if replay else 0,
            on,
            mapper.roster.frozen,
            self._rate(self._taken),
            self._measured.voxels,
            self._measured.bricks,
            self._measured.memory_mb,
            replay.paused if replay else False,
            replay.finished if replay else True,
            waiting or mapper.edited,
            replay.speed if replay and replay.has_pace else None,
            mapper.map.promise.sentence() if mapper.map.promise and mapper.map.settled else "",
            mapper.edits.can_undo,
            mapper.edits.can_redo,
            self._arrivals(replay),
            lack_of_surface(mapper.map),
            tuple(name for name, layer in mapper.map.pixel_layers.items() if layer),
        )

    def time_left(self, replay: Replay) -> str:
        """In words, how long the frames that are left take at the pace of the last ones; empty if that is not
        known."""
        if not replay.frames:
            return ""
        now, done = self._clock(), replay.number
        if not self._pace or self._pace[-1][1] != done:
            self._pace.append((now, done))
        while len(self._pace) > 2 and self._pace[1][0] < now - PACE_SECONDS:
            self._pace.popleft()
        since, first = self._pace[0]
        if done - first < LEAST_FRAMES:
            return ""
        return f", {in_words((now - since) * (replay.frames - done) / (done - first))} left"

    def _arrivals(self, replay: Replay | None) -> str:
        """In words, how many frames a sensor that runs sends, how many are looked at, and how long ago the
        newest of these was taken; empty for any other source."""
        arrivals = None if replay is None else replay.arrivals()
        if arrivals is None:
            return ""
        age = "" if arrivals.age_s is None else f", the newest {arrivals.age_s:.1f} s ago"
        return f"{arrivals.rate_hz:.1f}/s come, {self._rate(self._looked_at):.1f}/s are looked at{age}"

    def _rate(self, times: deque[float]) -> float:
        now = self._clock()
        while times and times[0] < now - RATE_SECONDS:
            times.popleft()
        return len(times) / max(min(RATE_SECONDS, now - self._begin), 1e-3)


def sweeping(step: InferProgress) -> tuple[str, float]:
    """A step of full inference in words, and how much of it is done."""
    done = (step.sweep - 1) * step.keyframes + step.keyframe
    sentence = f"sweeping keyframe {step.keyframe} of {step.keyframes} (sweep {step.sweep} of {step.sweeps})"
    return sentence, done / (step.sweeps * step.keyframes)


class Run(SessionCore):
    """One live run. ``mapper`` holds the map, ``intake`` takes frames into it; ``replay`` has the frames,
    None if there are none to come; ``follower`` moves keyframes with poses that change, None if they do not.

    ``stepping``: take frames until one more keyframe is added, at any pace. ``current`` is the frame
    that was read last. ``version`` changes with the map that is shown and with the current camera. ``full``
    is the reason if the last frame did not fit into memory, else None. ``selected_m`` are the centres (n, 3)
    of the voxels that a user has selected.
    """

    def __init__(self, source: Source, link: Link, policy: Policy) -> None:
        """Makes the map. Raises TaichiMRFError."""
        super().__init__(link, policy)
        self.version = 0
        self.full: str | None = None
        self._playing = False
        self.replay: Replay | None = None
        self.begin(source, first_id=0)

    def begin(self, source: Source, first_id: int) -> None:
        """Drop the map, if there is one, and start a source from its beginning, at the present speed. The
        viewer's numbers of keyframes begin at ``first_id``. If it raises, the old map stays."""
        m = source.new_map()
        window = window_of(m)
        if window is not None and self.policy.out is not None:
            window.park_beside(self.policy.out / MAP_FILE)
        intake = Intake(
            m,
            source.config,
            tracked=source.tracked,
            hold_out=source.hold_out,
            sweep=lambda id: self.mapper.sweep(id),
            remember_frames=self.policy.out is not None,
            before_adding=self._show_adding,
            fixed=lambda: self.mapper.placed_by_hand(),
            place=place_check_of(source.dataset),
        )
        replay = source.new_replay() if source.new_replay else None
        if replay is not None and self.replay is not None:
            replay.set_speed(self.replay.speed)
        self.source, self.intake, self.replay = source, intake, replay
        joined = bool(source.located)
        intake.result.before = keyframes_in(m) if joined else 0
        self.mapper = Mapper(intake.map, first_id, intake.refiner, source.own, joined)
        self.follower = follower_of(m, source.dataset, source.config.poses)
        intake.result.followed = None if self.follower is None else self.follower.done
        self.progress = Progress()
        self.current: Frame | None = None
        self.stepping, self.full = False, None
        self.selected_m = np.zeros((0, 3))
        self.send_everything()

    def send_everything(self) -> None:
        """Send a viewer that has just started the whole state."""
        m, among = self.mapper.map, self.source.among
        self.send(
            replace(
                self.mapper.hello(self.source.name),
                parameters=to_yaml(self.source.config),
                can_freeze=can_freeze(m),
                has_dates=self.mapper.shown.has_dates,
                has_surface=measures_surface(m),
                counts_keyframes=has_messages(m),
                has_frames=self.source.new_replay is not None,
                recordings=() if among is None else among.names,
                recording=self.source.place,
                located=self.source.located,
            )
        )
        if self.mapper.saved_unsettled and self.mapper.unsettled:
            name = self.source.choice.get("onto") or self.source.name
            self.send(Notice(saved_unsettled(name), "warning"))
        for entry in self.mapper.roster.entries.values():
            self.send(self.mapper.describe(entry))
        if self.current is not None:
            self.show_camera(self.current)
        self.mapper.shown.start_over()
        self.publish()

    def select(self, request: Select) -> None:
        """Note the voxels that a user of the page has selected."""
        self.selected_m = request.points_m

    def look_at_keyframes(self) -> None:
        """Show what another program has done to its map's keyframes since the last call."""
        changed = self.mapper.done_elsewhere()
        if changed is None:
            self.mapper = Mapper(self.mapper.map, self.mapper.roster.next_id, own=True)
            self.send_everything()
        else:
            for info in changed:
                self.send(info)

    def publish(self) -> None:
        """Send the changes of the map, and measure its size."""
        for info in self.mapper.left_behind():
            self.send(info)
        self._send_layers(self.mapper.shown.changes())
        self._send_time()
        self.progress.measure(self.mapper)

    def show_time(self, stamp_s: float | None, play: bool = False) -> None:
        """Show the map as of a time in seconds, None for now, once there is time to read it; ``play`` goes on
        from there to later times."""
        self._playing = play
        self.mapper.shown.show(stamp_s)
        self._send_time()

    def renew_past(self) -> bool:
        """Send what is shown of the past if it is outdated; returns whether there was anything to send. If it
        is played and was sent, go on to the next time."""
        sent = self._send_layers(self.mapper.shown.renew())
        span = self._time_span() if self._playing and not sent else None
        if span is not None and span.shown_s is not None:
            later_s = span.shown_s + (span.now_s - span.first_s) / PLAY_STEPS
            play = later_s < span.now_s
            self.show_time(later_s if play else None, play)
        return sent

    def decide(self, between: Callable[[], object]) -> None:
        """Show what is occupied; ``between`` is called after each keyframe."""
        self._send_layers(self.mapper.shown.decide(between))

    def show_camera(self, frame: Frame) -> None:
        """Show the viewer the pose of a frame."""
        self.current = frame
        self.version += 1
        self.send(CurrentCamera(frame.name, frame.T_world_camera, outlined(frame.camera)))

    def describe(self, id: int) -> KeyframeInfo:
        """The message that describes a keyframe to the viewer."""
        return self.mapper.describe(self.mapper.roster.find(id))

    def show_activity(self, activity: str, share: float) -> None:
        """Show the present activity in the viewer, and the share of it that is done, 0 to 1."""
        waiting = self.waiting.has_edits()
        self._tell_news()
        self.send(self.progress.status(activity, share, self.replay, self.mapper, waiting))

    def _tell_news(self) -> None:
        """Tell the viewer, and note for the report, what has come about at a sensor that runs."""
        arrivals, dataset = self.replay.arrivals() if self.replay else None, self.source.dataset
        if arrivals is None or dataset is None:
            return
        for text in arrivals.news:
            if text not in dataset.notes:
                dataset.notes.append(text)
                self.send(Notice(text, "warning"))

    def notice_error(self, error: Exception) -> None:
        """Tell the viewer what went wrong; a map that is full also pauses the replay."""
        super().notice_error(error)
        if isinstance(error, CapacityError) and self.replay is not None:
            self.full = str(error)
            self.replay.pause()
            self.stepping = False

    def result(self) -> MappingResult:
        """Result of the run so far, as a batch run reports it."""
        result, replay, inferred = self.intake.result, self.replay, self.mapper.inferred
        result.interrupted, result.full = not self.is_done, self.full
        if replay is not None:
            result.frames = replay.frames if replay.finished and replay.frames else replay.number
            if not self.source.tracked:
                result.held_out = list(replay.held_out)
        if inferred is not None:
            result.sweeps, result.residual = inferred.sweeps, inferred.residual
        if self.mapper.refiner is not None:
            result.poses = self.mapper.refiner.changes()
        return result

    @property
    def facts(self) -> RunFacts:
        """The facts of the run's report besides its result."""
        source = self.source
        return RunFacts(source.name, source.config, source.dataset, source.choice, learnt=source.learnt)

    @property
    def has_frames_left(self) -> bool:
        """True if the source has not ended."""
        return self.replay is not None and not self.replay.finished

    @property
    def is_replaying(self) -> bool:
        """True if frames are being replayed, or a single step was asked for."""
        return (
            self.replay is not None and not self.replay.finished and (self.stepping or not self.replay.paused)
        )

    @property
    def is_done(self) -> bool:
        """True if all frames are in the map, or as many as there is room for, and it is the one that they
        give."""
        frames_left = self.has_frames_left and self.full is None
        poses_may_change = self.follower is not None and not self.follower.is_final
        return not (frames_left or poses_may_change or self.mapper.unsettled or self.mapper.unaligned)

    def idle(self) -> float:
        """Show why there is nothing to do; returns the seconds until the next frame, if one is due earlier
        than requests are looked at."""
        self.show_activity(self._idle_activity, 1.0)
        due = self.replay.due_in() if self.replay else None
        return WAIT_SECONDS if due is None else min(due, WAIT_SECONDS)

    @property
    def _idle_activity(self) -> str:
        """In words, why there is nothing to do."""
        if self.replay is None:
            return "waiting: the map is up to date"
        if self.replay.finished:
            doing = "done" if self.follower is None else f"following {self.follower.name}"
            return self.replay.problem or f"{doing}: the map is up to date"
        if self.replay.paused:
            return "waiting: paused"
        return f"waiting for {self.replay.awaiting or 'the next frame'}"

    def _send_layers(self, layers: list[Bricks]) -> bool:
        for bricks in layers:
            self.send(bricks)
        self.version += bool(layers)
        return bool(layers)

    def _time_span(self) -> TimeSpan | None:
        return time_span(self.mapper.shown, self.mapper.roster.entries.values())

    def _send_time(self) -> None:
        span = self._time_span()
        if span is not None:
            self.send(span)

    def _show_adding(self, frame: Frame) -> None:
        self.show_camera(frame)
        self.show_activity(f"adding {frame.name}", self.replay.share if self.replay else 0.0)


def time_span(shown: ShownMap, entries: Collection[LiveKeyframe]) -> TimeSpan | None:
    """The times at which a map can be shown; None for a map without dates or keyframes.

    Frozen keyframes count from the newest of them on, and before that the map would lack them.
    """
    on = [entry.stamp_s for entry in entries if entry.state == "on"]
    frozen = [entry.stamp_s for entry in entries if entry.state == "frozen"]
    if not shown.has_dates or not on + frozen:
        return None
    first = max(frozen) if frozen else min(on)
    start = min(entry.stamp_s for entry in entries)  # also of those that are off, or all times would shift
    return TimeSpan(start, first, max(on + frozen), shown.stamp_s)
