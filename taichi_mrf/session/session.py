"""A live session: frames become keyframes, the map is published, and the viewer's requests are carried out.

One thread does all of it, one piece of work after the other, because Taichi may be used by one thread only:

    requests that have arrived
    keyframes whose poses have changed         if poses follow a file: move and show some of them
    full inference, if frames are to join an earlier map that is not inferred
    a frame, if one is due                     track its pose if it has none, add it, align it if poses are
                                               refined, sweep it once, then the keyframes whose cavity has
                                               changed; publish the changes
    else sweep more keyframes whose cavity has changed, if any are left
    else rounds of alignment                   once the sequence has ended, if poses are to be refined
    else full inference, if the map needs it   requests are answered from the map as it was before
    else the images of a view and the baseline, if they are shown, and messages to those who subscribe
    else wait
"""

import math
import time
from collections.abc import Callable, Generator

from taichi_mrf.errors import CapacityError, ConfigError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.mapping.follow import BETWEEN_FRAMES_S
from taichi_mrf.mapping.intake import Added, Full, Lost, Skipped, UnreadableFrame
from taichi_mrf.mapping.loops import Closure
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.rounds import AlignmentRounds, RoundStep
from taichi_mrf.mapping.settling import FullInference
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.extras import Extras
from taichi_mrf.session.link import Link
from taichi_mrf.session.mapper import LiveKeyframe
from taichi_mrf.session.message_server import MessageServer
from taichi_mrf.session.replay import Replay
from taichi_mrf.session.requests import Requests, resumes_replay
from taichi_mrf.session.run import Run, sweeping
from taichi_mrf.session.session_core import EDITS, OF_KEYFRAMES, Policy
from taichi_mrf.session.source import Source
from taichi_mrf.viewer.messages import Listening, Notice, Request, Reset

REQUEST_SECONDS = 0.25
"""While frames arrive, the longest time for requests before the next frame is taken, in seconds, so that many
clients cannot stop mapping."""

ASK_SECONDS = 0.05
"""Shortest time between two looks at requests while keyframes are aligned, in seconds."""

WAY_BACK = "bring the camera back to where it was then, or to where it started"


class Session:
    """Runs a live run; its state is :attr:`state`."""

    def __init__(
        self,
        source: Source,
        link: Link,
        policy: Policy,
        listening: Callable[[Listening], None] = lambda where: None,
        server: MessageServer | None = None,
    ) -> None:
        """Makes the map and sends it to the viewer. ``listening`` is called with the address of the page,
        ``server`` serves the map to others. Raises TaichiMRFError."""
        self.state = Run(source, link, policy)
        self._extras = Extras(self.state, server)
        self._requests = Requests(self.state, self._extras, listening, self._begin_anew)
        self._asked = float("-inf")

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Work until told to stop (:meth:`.SessionCore.work_until_over`). Can be called again, after
        :meth:`reconnect` for instance."""
        self.state.work_until_over(should_stop, self.answer, self._work)

    def answer(self) -> None:
        """Carry out what the page has asked for."""
        self.state.read_requests()
        self._carry_out_waiting()

    def rest(self) -> None:
        """Use a time without other work for what the page shows beside the map."""
        self._extras.work(self._go_on)

    def reconnect(self, link: Link) -> None:
        """Go on with another viewer, which is sent the whole state."""
        self.state.link = link
        self.state.send_everything()
        self._extras.start_again_for_viewer()

    def _begin_anew(self, reset: Reset) -> None:
        """Start the source again, or another one of those that it was chosen among."""
        state, notes = self.state, list[str]()
        source, among = state.source, state.source.among
        if reset.recording is not None:
            if among is None:
                raise ConfigError(f"{source.name}: there are no other recordings to choose from")
            state.show_activity("opening another recording", 0.0)
            source, notes = among.open(reset.recording)
        state.begin(source, state.mapper.roster.next_id)
        self._extras.start_over()
        for note in notes:
            state.send(Notice(note))

    def _carry_out_waiting(self) -> None:
        """Carry out what has been asked for; signals are looked at between any two requests."""
        state, begin = self.state, time.monotonic()
        while len(state.waiting) and not state.is_over and self._may_carry_out(state.waiting.next):
            self._requests.carry_out(state.waiting.take())
            if state.is_replaying and time.monotonic() - begin > REQUEST_SECONDS:
                return

    def _work(self) -> bool:
        """Do the next piece of work; returns whether there was any."""
        state, mapper = self.state, self.state.mapper
        moved = self._follow()
        # Keyframes of an earlier map send their messages before others join them.
        if (mapper.stale and mapper.unsettled) or (mapper.lacks_messages and state.is_replaying):
            return self._settle()
        if state.replay is not None and state.is_replaying and self._is_due(state.replay):
            self._take_frame(state.replay)
            self._extras.work(self._go_on)
            return True
        if moved:
            return True
        if mapper.cavities_changed and state.is_replaying:
            state.show_activity("sweeping keyframes whose evidence has changed", 0.0)
            state.guarded(mapper.renew)
            state.publish()
            return True
        if mapper.unaligned and mapper.refiner is not None and not state.has_frames_left:
            return self._align(mapper.refiner)
        if (mapper.unsettled or self._needs_messages) and not state.is_replaying:
            return self._follow(exactly=True) or self._settle()
        return self._extras.work(self._go_on)

    @property
    def _needs_messages(self) -> bool:
        """True if an edit or what the page shows waits for the messages of a map from a file."""
        mapper = self.state.mapper
        wanted = (
            self.state.waiting.has_edits() or self._extras.need_messages or mapper.shown.stamp_s is not None
        )
        return mapper.lacks_messages and wanted

    def _follow(self, exactly: bool = False) -> bool:
        """Move keyframes whose poses have changed, for a limited time, and show them; returns whether any
        moved. ``exactly``: also those that the change moves hardly at all."""
        state, mapper, follower = self.state, self.state.mapper, self.state.follower
        if follower is None or mapper.lacks_messages:
            return False
        moved: list[LiveKeyframe] = []

        def follow() -> None:
            looks = follower.look_exactly if exactly else lambda: follower.look(self._time_s())
            if not looks():
                return
            if follower.left > 1:
                state.show_activity(f"moving keyframes to new poses: {follower.left} left", 0.0)
            least = 0.0 if exactly else None
            ids = follower.move(BETWEEN_FRAMES_S, least, mapper.placed_by_hand())
            moved.extend(mapper.follow(ids))
            for entry in moved:
                state.send(mapper.describe(entry))
            if moved:
                state.publish()

        with state.intake.result.timed("following"):
            state.guarded(follow)
        for text in follower.news():
            state.send(Notice(text, "warning"))
        return bool(moved)

    def _time_s(self) -> float:
        """The recording's time in seconds, for poses that change; infinite after its last frame."""
        current = self.state.current
        return math.inf if current is None or not self.state.has_frames_left else current.stamp

    def _is_due(self, replay: Replay) -> bool:
        return self.state.stepping or replay.due_in() == 0

    def _take_frame(self, replay: Replay) -> None:
        """Read the next frame, and offer it to the map."""
        state = self.state
        of = f" of {replay.frames}" if replay.frames else ""
        state.show_activity(f"reading frame {replay.next_number}{of}", replay.share)
        with state.intake.result.timed("reading"):
            frame = replay.take()
        state.progress.frame_looked_at()
        if frame is not None:
            state.guarded(lambda: self._offer(frame, replay))
        if replay.finished:
            state.stepping = False

    def _offer(self, frame: Frame | UnreadableFrame, replay: Replay) -> None:
        state, tracker = self.state, self.state.intake.tracker
        lost_before = 0 if tracker is None else tracker.lost
        answer = state.intake.offer(frame, replay.number, replay.index)
        if lost_before and not isinstance(answer, Lost | Skipped):
            state.send(Notice(f"{frame.name}: tracking goes on after {lost_before} lost frames"))
        if isinstance(answer, Skipped):
            ends = isinstance(frame, UnreadableFrame) and frame.last
            text = f"{answer.problem}; what is mapped stays" if ends else answer.problem
            state.send(Notice(text, "error"))
        elif isinstance(answer, Lost):
            if answer.in_a_row == 1:
                state.send(Notice(f"{answer.problem}; {WAY_BACK}", "warning"))
        elif isinstance(answer, Full):
            raise CapacityError(answer.problem) from answer.error
        elif isinstance(answer, Added):
            self._show_added(answer)
        elif answer.frame is not None:
            state.show_camera(answer.frame)

    def _show_added(self, added: Added) -> None:
        state = self.state
        entry = state.mapper.enter(added)
        state.full = None
        state.progress.keyframe_taken()
        state.send(state.mapper.describe(entry))
        if added.closure is not None:
            self._show_closed(added.closure)
        if added.doubt:
            state.send(Notice(added.doubt, "warning"))
        state.mapper.renew()
        if state.policy.keep_live is not None:
            for each in state.mapper.surplus(entry, state.policy.keep_live):
                state.send(state.mapper.freeze(each.id, by_hand=False))
        state.publish()
        if state.stepping and state.replay is not None:
            state.stepping = False
            state.replay.pause()

    def _show_closed(self, closure: Closure) -> None:
        state = self.state
        for entry in state.mapper.follow(closure.moved):
            state.send(state.mapper.describe(entry))
        far, count = f"{100 * closure.off_m:.0f} cm", len(closure.moved)
        what = "1 keyframe" if count == 1 else f"{count} keyframes"
        state.send(Notice(f"loop closed: the camera was off by {far}, {what} moved"))

    def _settle(self) -> bool:
        def settle() -> None:
            mapper = self.state.mapper
            with self.state.intake.result.timed("inferring"), mapper.settling() as inference:
                for step in inference:
                    with inference.showing_before():
                        go_on = self._go_on_sweeping(step)
                    if not go_on:
                        inference.stop(at_once=True)
            if inference.outcome is not None:
                self.state.publish()

        self.state.guarded(settle)
        return True

    def _align(self, refiner: PoseRefiner) -> bool:
        """Rounds of alignment. Each keyframe that moves is swept and shown at once, so that the map is whole
        between any two of them; what is asked for meanwhile is answered, or ends the rounds if it is an
        edit."""
        state, mapper = self.state, self.state.mapper

        def align() -> None:
            mapper.unaligned = False  # or a failure would be repeated without end
            mover = _ShowingMover(state)
            rounds = AlignmentRounds(refiner, mover, mapper.placed_by_hand())
            with state.intake.result.timed("refining"), rounds:
                for step in rounds:
                    if not self._go_on_aligning(step):
                        rounds.stop()
            mapper.unaligned = not rounds.outcome
            state.publish()

        state.guarded(align)
        return True

    def _go_on_aligning(self, step: RoundStep) -> bool:
        now = time.monotonic()
        if not step.judging and now - self._asked < ASK_SECONDS:
            return True
        self._asked = now
        doing = f"aligning all keyframes: round {step.round} of {step.rounds}"
        doing = "sweeping aligned keyframes" if step.judging else doing
        self.state.show_activity(doing, max(step.round - 1, 0) / step.rounds)
        return self._go_on()

    def _go_on_sweeping(self, step: InferProgress) -> bool:
        self.state.show_activity(*sweeping(step))
        return self._go_on(step)

    def _go_on(self, step: InferProgress | None = None) -> bool:
        """Between two steps of long work: carry out the requests that can be; returns whether to go on."""
        state = self.state
        state.read_requests()
        kept: list[Request] = []
        go_on = not state.is_over
        while len(state.waiting) and go_on:
            request = state.waiting.take()
            if isinstance(request, EDITS) or (resumes_replay(request) and state.has_frames_left):
                kept.append(request)
                go_on = not self._may_carry_out(request)
            else:
                self._requests.carry_out(request)
                go_on = not state.is_over
        state.waiting.put_back(kept)
        if go_on and state.follower is not None:
            go_on = not state.follower.look(self._time_s())
        if go_on:
            self._extras.answer()
        return go_on

    def _may_carry_out(self, request: Request) -> bool:
        """Edits of keyframes of a map from a file wait for its messages, which only full inference brings."""
        return not (self.state.mapper.lacks_messages and isinstance(request, OF_KEYFRAMES))


class _ShowingMover:
    """Moves keyframes as a user would: each is swept at its new pose and shown."""

    def __init__(self, state: Run) -> None:
        self._state = state
        entries = state.mapper.roster.with_state("on")
        self._entries = {entry.map_id: entry for entry in entries if entry.map_id is not None}

    def move(self, id: int, T_world_camera: Pose) -> None:
        entry, mapper = self._entries[id], self._state.mapper
        if mapper.align(entry, T_world_camera):
            self._state.send(mapper.describe(entry))
            self._state.publish()

    def sweep(self) -> Generator[InferProgress, None, object]:
        """From no messages, as in a batch run: what is found must not depend on how the map came about. Until
        the end the page shows the map as it was."""
        with FullInference(self._state.mapper.map, sweeps=1, keep_before=True) as inference:
            for step in inference:
                with inference.showing_before():
                    yield step
        return inference.outcome
