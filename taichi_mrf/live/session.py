"""A live session: frames become keyframes, the map is published, and the viewer's requests are carried out.

One thread does all of it, one piece after the other, because Taichi has one owner:

    requests that have come
    a frame, if one is due                     find its pose if need be, add it, align it if poses are to be
                                               refined, sweep it once, and for a while those to whom it said
                                               something new; publish what has changed
    else more of those, if any are left
    else rounds of alignment                   once the sequence has ended, if poses are to be refined
    else full inference, if the map needs it   requests are answered from the map as it was before
    else what is shown beside the map
    else wait
"""

from collections import deque
from collections.abc import Callable

from taichi_mrf.errors import CapacityError
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.live.extras import Extras
from taichi_mrf.live.link import Link
from taichi_mrf.live.live_keyframes import Entry
from taichi_mrf.live.progress import sweeping
from taichi_mrf.live.replay import BrokenFrame, Replay
from taichi_mrf.live.requests import EDITS, Requests, goes_on
from taichi_mrf.live.rounds import Rounds
from taichi_mrf.live.run import Policy, Run, Source
from taichi_mrf.mapping.selection import KeyframeSelector
from taichi_mrf.mapping.tracking import keyframe_steps
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.viewer.messages import Listening, Notice, Request

WAIT_SECONDS = 0.25
"""So long at most it takes until a signal is noticed while there is nothing to do."""


class Session:
    """Runs a live run; its state is :attr:`state`."""

    def __init__(
        self,
        source: Source,
        link: Link,
        policy: Policy,
        listening: Callable[[Listening], None] = lambda where: None,
    ) -> None:
        """Makes the map and tells the viewer of it. ``listening`` is called when the viewer says where its
        page is. Raises TaichiMRFError."""
        self.state = Run(source, link, policy)
        self._extras = Extras(self.state)
        self._requests = Requests(self.state, self._extras, listening, self._begin_anew)
        self._selector = self._new_selector()
        self._should_stop: Callable[[], bool] = lambda: False

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Work until told to stop: by ``should_stop``, by the viewer's Quit, or because the link is lost.

        Can be called again, after :meth:`reconnect` for instance.
        """
        self._should_stop, state = should_stop, self.state
        while not self._is_over():
            self._hear()
            while state.waiting and not state.ended and self._may_carry_out(state.waiting[0]):
                self._requests.carry_out(state.waiting.popleft())
            if not self._is_over() and not self._work():
                if state.policy.leave_when_done and state.is_done:
                    return
                self._tell(state.idle_activity, 1.0)
                due = state.replay.due_in() if state.replay else None
                state.link.wait(WAIT_SECONDS if due is None else min(due, WAIT_SECONDS))

    def reconnect(self, link: Link) -> None:
        """Go on with another viewer, which is told all that there is."""
        self.state.link = link
        self._extras.nothing_wanted()
        self.state.greet()

    def _begin_anew(self) -> None:
        self.state.begin(self.state.mapper.roster.next_id)
        self._extras.start_over()
        self._selector = self._new_selector()

    def _new_selector(self) -> KeyframeSelector:
        source = self.state.source
        config = source.config.keyframes
        return KeyframeSelector(keyframe_steps(config) if source.tracked else config)

    def _is_over(self) -> bool:
        return self._should_stop() or self.state.ended or self.state.link.lost is not None

    def _hear(self) -> None:
        self.state.waiting.extend(self.state.link.requests())

    def _tell(self, activity: str, share: float) -> None:
        edits_wait = any(isinstance(request, EDITS) for request in self.state.waiting)
        self.state.tell(activity, share, edits_wait)

    def _work(self) -> bool:
        """Do the next piece of work; returns whether there was any."""
        state, mapper = self.state, self.state.mapper
        if mapper.stale and mapper.unsettled:
            return self._settle()
        if state.replay is not None and state.is_replaying and self._is_due(state.replay):
            self._take_frame(state.replay)
            self._extras.work(self._go_on)
            return True
        if mapper.unanswered and state.is_replaying:
            self._tell("sweeping keyframes whose evidence has changed", 0.0)
            state.guarded(mapper.renew)
            state.publish()
            return True
        if mapper.unaligned and not state.has_frames_left:
            return self._align()
        if mapper.unsettled and not state.is_replaying:
            return self._settle()
        return self._extras.work(self._go_on)

    def _is_due(self, replay: Replay) -> bool:
        return self.state.stepping or replay.due_in() == 0

    def _take_frame(self, replay: Replay) -> None:
        """Read the next frame and, if it is to be a keyframe, put it into the map."""
        of = f" of {replay.frames}" if replay.frames else ""
        self._tell(f"reading frame {replay.next_number}{of}", replay.share)
        frame = replay.take()
        if isinstance(frame, BrokenFrame):
            text = f"{frame.problem}; what is mapped stays" if frame.last else frame.problem
            self.state.send(Notice(text, "error"))
        elif frame is not None and (frame := self.state.located(frame)) is not None:
            self.state.show_camera(frame)
            if self._selector.wants(frame.T_world_camera) and (frame.depth_m > 0).any():
                self._tell(f"adding {frame.name}", replay.share)
                self.state.guarded(lambda: self._take_in(frame))
        if replay.finished:
            self.state.stepping = False

    def _take_in(self, frame: Frame) -> None:
        state = self.state
        try:
            entry = state.mapper.take_in(frame)
        except CapacityError as error:
            raise CapacityError(f"frame {frame.name} does not fit: {error}") from error
        state.full = None
        state.tracked_keyframe(entry)
        self._selector.accept(frame.T_world_camera)
        state.progress.keyframe_taken()
        state.send(state.mapper.describe(entry))
        state.mapper.renew()
        if state.policy.keep_live is not None:
            for each in state.mapper.surplus(entry, state.policy.keep_live):
                state.send(state.mapper.freeze(each.id, by_hand=False))
        state.publish()
        if state.stepping and state.replay is not None:
            state.stepping = False
            state.replay.pause()

    def _settle(self) -> bool:
        def settle() -> None:
            if self.state.mapper.settle(self._go_on_sweeping):
                self.state.publish()

        self.state.guarded(settle)
        return True

    def _align(self) -> bool:
        state, mapper = self.state, self.state.mapper
        assert mapper.refiner is not None

        def show(entry: Entry) -> None:
            state.send(mapper.describe(entry))
            state.publish()

        def align() -> None:
            assert mapper.refiner is not None
            mapper.unaligned = False  # or what goes wrong would be tried again without end
            mapper.unaligned = not Rounds(mapper, mapper.refiner, self._go_on_aligning, show).run()
            state.publish()

        state.guarded(align)
        return True

    def _go_on_aligning(self, activity: str, share: float) -> bool:
        self._tell(activity, share)
        return self._go_on()

    def _go_on_sweeping(self, step: InferProgress) -> bool:
        self._tell(*sweeping(step))
        return self._go_on(step)

    def _go_on(self, step: InferProgress | None = None) -> bool:
        """Between two steps of a long piece of work: answer what can be, and say whether to go on."""
        state = self.state
        self._hear()
        kept: deque[Request] = deque()
        go_on = not self._is_over()
        while state.waiting and go_on:
            request = state.waiting.popleft()
            if isinstance(request, EDITS) or (goes_on(request) and state.has_frames_left):
                kept.append(request)
                go_on = not self._may_carry_out(request)
            else:
                self._requests.carry_out(request)
                go_on = not self._is_over()
        state.waiting.extendleft(reversed(kept))
        if go_on:
            self._extras.answer()
        return go_on

    def _may_carry_out(self, request: Request) -> bool:
        """Edits of a map from a file wait for its messages, which only full inference brings."""
        return not (self.state.mapper.lacks_messages and isinstance(request, EDITS))
