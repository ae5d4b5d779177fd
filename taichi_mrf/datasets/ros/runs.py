"""The run of a bag that is mapped, where the clock of its sensor starts again while it is recorded."""

from collections.abc import Sequence
from dataclasses import dataclass

from taichi_mrf.datasets.ros.reader import Entry, RosReader
from taichi_mrf.datasets.runs import choose_run, starts_of_runs

NEAR_NS = 5_000_000_000
"""Other topics see the clock start again at most this much before or after the sensor's."""

Gap = tuple[int, int]
"""The times of recording of the last message of a run and the first of the next, in nanoseconds."""


@dataclass(frozen=True)
class BagRun:
    """A run, between two gaps; None where the recording begins or ends."""

    before: Gap | None = None
    after: Gap | None = None

    def part(self, stamps: Sequence[float], recorded_ns: Sequence[int]) -> slice:
        """Which messages of a topic, or transforms of a frame, belong to the run."""
        if self.before is None and self.after is None:
            return slice(None)
        starts = starts_of_runs(stamps)[1:]
        first = 0 if self.before is None else _bound(self.before, starts, recorded_ns)
        return slice(first, None if self.after is None else _bound(self.after, starts, recorded_ns))

    def of(self, entries: Sequence[Entry]) -> Sequence[Entry]:
        """The messages of a topic that belong to the run."""
        return entries[
            self.part([entry.stamp for entry in entries], [entry.recorded_ns for entry in entries])
        ]

    def is_over(self, recorded_ns: int) -> bool:
        """Whether the run ended before this time of recording."""
        return self.after is not None and recorded_ns >= self.after[1]


def _bound(gap: Gap, starts: Sequence[int], recorded_ns: Sequence[int]) -> int:
    """The index of the first message after a gap: where the topic's own stamps start again near it, else by
    the time of recording."""
    middle = sum(gap) // 2
    near = [i for i in starts if gap[0] - NEAR_NS <= recorded_ns[i] <= gap[1] + NEAR_NS]
    if near:
        return min(near, key=lambda i: abs(recorded_ns[i] - middle))
    return next((i for i, ns in enumerate(recorded_ns) if ns >= gap[1]), len(recorded_ns))


def run_of(
    reader: RosReader, topic: str, entries: Sequence[Entry], wanted: int, what: str
) -> tuple[BagRun, Sequence[Entry], list[str]]:
    """The run that is read, its messages of the sensor's topic, and a note of the others. ``entries`` are all
    in the order of recording. Raises DatasetError if there is no such run."""
    if not entries:
        return BagRun(), entries, []
    where = f"{reader.path}: topic {topic}"
    number, bounds, notes = choose_run([entry.stamp for entry in entries], wanted, where, what)
    gaps: list[Gap | None] = [
        None,
        *((entries[i - 1].recorded_ns, entries[i].recorded_ns) for i in bounds[1:-1]),
        None,
    ]
    return BagRun(gaps[number], gaps[number + 1]), entries[bounds[number] : bounds[number + 1]], notes
