"""When the next frame of a source is due: at the recording's own pace, faster, slower, or immediately.

A frame's stamp is known only once it has been read, so at a given pace the next frame is read ahead. For a
frame that cannot be read, an UnreadableFrame is returned.
"""

import math
import time
from collections.abc import Callable

from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.base import Arrivals
from taichi_mrf.datasets.derived import later
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.mapping.intake import UnreadableFrame
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.sensor.frame import Frame

LOOK_S = 0.02
"""How often it is looked whether a source that never ends has its next frame."""


class Replay:
    """The frames 0, ``every``, 2 ``every``, ... of a source, ``limit`` of them at most, in time.

    ``number`` (from 1) is that of the frame taken last, of ``frames`` (0: without end); ``finished``: it was
    the last one; ``problem``: why, if the source broke off. While ``paused``, frames can still be taken one
    by one.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        every: int = 1,
        limit: int | None = None,
        loop: bool = False,
        hold_out: int = 0,
        speed: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``speed`` is the multiple of the recording's own pace, 0 as fast as possible. One frame in
        ``hold_out`` is passed unread, the same as in pipeline.map_sequence. ``clock`` returns the time in
        seconds.
        """
        self._dataset, self._clock = dataset, clock
        self._every, self._limit, self._loop, self._hold_out = every, limit, loop, hold_out
        self.number, self.paused, self.finished, self.problem = 0, False, False, ""
        self._next, self._readable = 1, False
        self._ahead: Frame | UnreadableFrame | None = None
        self.held_out: dict[int, None] = {}
        """Dataset indices of the frames that were passed unread, to check the map against."""
        self._first_s: float | None = None
        """Stamp of the first frame of this pass, as recorded."""
        self._last_s, self._step_s = 0.0, 1.0
        """Stamp of the last frame so far, and the time since the one before, in seconds."""
        self._later_s = 0.0
        """How much later than recorded the frames of this pass are."""
        self.has_pace = not dataset.endless
        """True if frames can come faster or slower: not those of a camera, or without a stamp."""
        self._begin: tuple[float, float] | None = None
        """A time on the clock, and the stamp of the frame that was due then."""
        self.set_speed(speed)
        self._find_next()

    @property
    def frames(self) -> int:
        """Frames in one pass through the source; 0 for a source without an end."""
        if self._dataset.endless:
            return self._limit or 0
        return len(range(0, len(self._dataset), self._every)[: self._limit])

    @property
    def share(self) -> float:
        """Share of the pass that has been taken, 0 to 1; 0 for a source without an end."""
        return min(1.0, self.number / self.frames) if self.frames else 0.0

    @property
    def next_number(self) -> int:
        """The number of the frame that will be taken next."""
        return self._next

    @property
    def index(self) -> int:
        """The dataset index of the frame taken last."""
        return self._index(self.number)

    @property
    def speed(self) -> float:
        """The multiple of the recording's own pace, 0 as fast as possible."""
        return self._speed

    @property
    def awaiting(self) -> str:
        """What a source that never ends waits for, in words."""
        return self._dataset.awaiting()

    def arrivals(self) -> Arrivals | None:
        """How the frames of a sensor that runs come, None for any other source."""
        return self._dataset.arrivals()

    def set_speed(self, factor: float) -> None:
        """Change the speed from here on. Raises ConfigError if it is negative or not finite."""
        if not (math.isfinite(factor) and factor >= 0):
            raise ConfigError(f"a speed must be 0 or a positive number, not {factor}")
        self._speed, self._begin = float(factor), None

    def pause(self) -> None:
        """Pause: no frame is due."""
        self.paused = True

    def resume(self) -> None:
        """Continue after a pause, whose duration does not count."""
        self.paused, self._begin = False, None

    def due_in(self) -> float | None:
        """Seconds until the next frame is due, 0 if it is, None while paused and after the last."""
        if self.paused or self.finished:
            return None
        if self._dataset.endless:
            return LOOK_S if self._dataset.awaiting() else 0.0
        if self._speed == 0:
            return 0.0
        if self._ahead is None:
            self._ahead = self._read()
        if isinstance(self._ahead, UnreadableFrame) or not math.isfinite(self._ahead.stamp):
            return 0.0
        now, stamp = self._clock(), self._ahead.stamp
        if self._begin is None:
            self._begin = (now, stamp)
        return max(0.0, self._begin[0] + (stamp - self._begin[1]) / self._speed - now)

    def take(self) -> Frame | UnreadableFrame | None:
        """The next frame, due or not; None after the last. Time goes on when a looped source starts again."""
        if self.finished:
            return None
        frame = self._ahead or self._read()
        self._ahead = None
        self._readable = self._readable or isinstance(frame, Frame)
        if isinstance(frame, Frame):
            self.has_pace = not self._dataset.endless and math.isfinite(frame.stamp)
            if math.isfinite(frame.stamp):
                self._note(frame.stamp)
                frame = later(frame, self._later_s)
        self.number, self._next = self._next, self._next + 1
        self._find_next()
        if isinstance(frame, UnreadableFrame) and frame.last:
            self.finished, self.problem = True, frame.problem
        return frame

    def _note(self, stamp_s: float) -> None:
        """Note the stamp of a frame that is taken."""
        if self._first_s is None:
            self._first_s = stamp_s
        elif stamp_s > self._last_s:
            self._step_s = stamp_s - self._last_s
        self._last_s = max(stamp_s, self._first_s)

    def _read(self) -> Frame | UnreadableFrame:
        index = self._index(self._next)
        try:
            return self._dataset.read(index)
        except FrameError as error:
            return UnreadableFrame(self._name(index), str(error))
        except DatasetError as error:
            return UnreadableFrame(self._name(index), str(error), last=True)
        except Exception as error:  # a defect in a reader must not end mapping
            return UnreadableFrame(self._name(index), f"{self._name(index)}: cannot be read: {error}")

    def _index(self, number: int) -> int:
        return (number - 1) * self._every

    def _name(self, index: int) -> str:
        names = self._dataset.frame_names
        return names[index] if index < len(names) else f"frame {index}"

    def _find_next(self) -> None:
        """Skip held-out frames; at the end of a looped source, continue with the next pass."""
        while True:
            over = self._next > self.frames and (self.frames > 0 or not self._dataset.endless)
            if over and not (self._loop and self._readable):  # a round of broken frames is the last
                self.finished = True
                return
            if over:
                self._next, self._readable, self._begin = 1, False, None
                if self._first_s is not None:
                    self._later_s += self._last_s - self._first_s + self._step_s
                self._first_s = None
            if not is_held_out(self._next, self._hold_out):
                return
            self.held_out[self._index(self._next)] = None
            self._next += 1
