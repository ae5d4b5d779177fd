"""``python -m benchmarks.lab.wire_events FILE live SOURCE ...``: the program, which notes what it does when.

A line of FILE each, with seconds on the monotonic clock: ``taken ARRIVED NOW NUMBER`` a frame of a robot;
``put NOW`` changes of the map, for the page; ``shown NOW`` all of a keyframe's are put; ``sent TAKEN NOW``
nothing more of them waits, and they were written to the page's process; ``whole NOW`` full inference begins.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taichi_mrf.cli.main import main
from taichi_mrf.datasets.wires.stream import Robot
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.outbox import Outbox, WaitingBricks
from taichi_mrf.session.session import Session
from taichi_mrf.viewer.messages import Bricks, Quit, Update


def note_into(path: Path) -> None:
    """From now on what is done is noted."""
    out = open(path, "a", buffering=1, encoding="utf-8")  # noqa: SIM115 - until the program ends
    read, put, take = Robot.read, Outbox.put, Outbox.take
    added, settle = Session._show_added, Session._settle
    taken_s: list[float] = []

    def note(*words: object) -> None:
        out.write(" ".join(map(str, words)) + "\n")

    def noted(name: str, work: Callable[..., Any], after: bool) -> Callable[..., Any]:
        def whole(self: Session, *arguments: Any) -> Any:
            if not after:
                note(name, time.monotonic())
            found = work(self, *arguments)
            if after:
                note(name, time.monotonic())
            return found

        return whole

    def read_noted(self: Robot, index: int) -> Frame:
        frame = read(self, index)
        note("taken", self._read_s, time.monotonic(), int(frame.name))
        return frame

    def put_noted(self: Outbox, update: Update) -> None:
        if isinstance(update, Bricks):
            note("put", time.monotonic())
        put(self, update)

    def take_noted(self: Outbox) -> Update | Quit:
        if taken_s:
            note("sent", taken_s.pop(), time.monotonic())
        update = take(self)
        waits = any(isinstance(each, WaitingBricks) for each in list(self._waiting.values()))
        if isinstance(update, Bricks) and not waits:
            taken_s.append(time.monotonic())
        return update

    Robot.read, Outbox.put, Outbox.take = read_noted, put_noted, take_noted  # type: ignore[method-assign]
    Session._show_added = noted("shown", added, after=True)  # type: ignore[method-assign]
    Session._settle = noted("whole", settle, after=False)  # type: ignore[method-assign]


if __name__ == "__main__":
    note_into(Path(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
