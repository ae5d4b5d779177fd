"""The run of a bag that is mapped, where the clock of its sensor starts again while it is recorded."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from taichi_mrf.datasets.ros.sources import Entry, TopicSource
from taichi_mrf.datasets.trajectories import starts_of_runs
from taichi_mrf.errors import DatasetError

NEAR_NS = 5_000_000_000
"""Other topics see the clock start again at most this much before or after the sensor's."""

Gap = tuple[int, int]
"""The places in the order of recording of the last message of a run and the first of the next."""


@dataclass(frozen=True)
class BagRun:
    """The ``number`` of a run, from 0, of those between gaps."""

    number: int = 0
    gaps: tuple[Gap, ...] = ()

    def part(self, stamps: Sequence[float], places: Sequence[int]) -> Sequence[int]:
        """Numbers of the messages of a topic, or transforms of a frame, that belong to the run."""
        if not self.gaps:
            return range(len(stamps))
        order = sorted(range(len(stamps)), key=places.__getitem__)
        starts = starts_of_runs([stamps[i] for i in order])[1:]
        ordered = [places[i] for i in order]
        if len(starts) != len(self.gaps):
            starts = [_bound(gap, starts, ordered) for gap in self.gaps]
        bounds = [0, *starts, len(order)]
        return order[bounds[self.number] : bounds[self.number + 1]]

    def of(self, entries: Sequence[Entry]) -> list[Entry]:
        """The messages of a topic that belong to the run."""
        part = self.part([entry.stamp for entry in entries], [entry.place for entry in entries])
        return [entries[i] for i in part]

    def is_over(self, place: int) -> bool:
        """True if the run ended before this place in the order of recording."""
        return self.number < len(self.gaps) and place >= self.gaps[self.number][1]


def _bound(gap: Gap, starts: Sequence[int], places: Sequence[int]) -> int:
    """The number of the first message after a gap: where the topic's own stamps start again near it, else by
    the order of recording."""
    middle = sum(gap) // 2
    near = [i for i in starts if gap[0] - NEAR_NS <= places[i] <= gap[1] + NEAR_NS]
    if near:
        return min(near, key=lambda i: abs(places[i] - middle))
    return next((i for i, place in enumerate(places) if place >= gap[1]), len(places))


def choose_run(
    stamps: Sequence[float], wanted: int, where: str, what: str
) -> tuple[int, list[int], list[str]]:
    """The number, from 0, of the run that the user wants (from 1; 0 is the longest), the bounds of all runs,
    and a note that names the others. ``where`` is the recording, ``what`` has stamps, such as images. Raises
    DatasetError if there is no such run."""
    bounds = [*starts_of_runs(stamps), len(stamps)]
    parts = list(pairwise(bounds))
    words = [
        f"run {i + 1} ({stamps[first]:.3f} to {stamps[stop - 1]:.3f} s, {stop - first} {what})"
        for i, (first, stop) in enumerate(parts)
    ]
    if not 0 <= wanted <= len(parts):
        raise DatasetError(f"{where}: there is no run {wanted}; it has {', '.join(words)}")
    number = wanted - 1 if wanted else max(range(len(parts)), key=lambda i: parts[i][1] - parts[i][0])
    if len(parts) == 1:
        return number, bounds, []
    others = ", ".join(each for i, each in enumerate(words) if i != number)
    return (
        number,
        bounds,
        [f"the clock restarts: of {words[number]} and {others}, the first is read (?run=N)"],
    )


def run_of(
    reader: TopicSource, topic: str, entries: Sequence[Entry], wanted: int, what: str
) -> tuple[BagRun, Sequence[Entry], list[str]]:
    """The run that is read, its messages of the sensor's topic, and a note of the others. Raises DatasetError
    if there is no such run."""
    places = reader.places(topic)
    if len(starts_of_runs([time / 1e9 for time, _ in sorted(places, key=lambda each: each[1])])) > 1:
        reader.by_file = True  # the recorder's clock started again as well
        at = {(entry.recorded_ns, entry.ordinal): entry for entry, _ in reader.messages(topic)}
        entries = sorted(
            (replace(entry, place=at[entry.recorded_ns, entry.ordinal].place) for entry in entries),
            key=lambda entry: entry.place,
        )
    where = f"{reader.path}: topic {topic}"
    number, bounds, notes = choose_run([entry.stamp for entry in entries], wanted, where, what)
    gaps = tuple((entries[i - 1].place, entries[i].place) for i in bounds[1:-1])
    return BagRun(number, gaps), entries[bounds[number] : bounds[number + 1]], notes
