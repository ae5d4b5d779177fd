"""The table of all tries: parameters, scores, the reference; and the files made of it."""

import csv
import dataclasses
import io
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import commented_yaml, differences
from taichi_mrf.errors import ConfigError
from taichi_mrf.viewer.tune.messages import By, Scores, Tried, scores_in_words

TABLE_FILE = "tries.csv"
BEST_FILE = "best.yaml"


@dataclass
class Attempt:
    """One try: its parameters, its scores, and whether a person or the search asked for it."""

    number: int
    config: Config
    scores: Scores
    by: By

    def message(self) -> Tried:
        """The message that tells the page of it."""
        return Tried(self.number, self.config, self.scores, self.by)


class History:
    """All tries on one working set, in the order in which they were made, numbered from 0.

    ``pinned`` is the number of the reference, the first try until another one is chosen.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.attempts: list[Attempt] = []
        self.pinned = 0

    def note(self, config: Config, scores: Scores, by: By) -> Attempt:
        """Add a try. Parameters that were tried before update that try, unless the new scores use fewer
        pixels."""
        known = next((each for each in self.attempts if each.config == config), None)
        if known is None:
            known = Attempt(len(self.attempts), config, scores, by)
            self.attempts.append(known)
        elif scores.pixel_stride <= known.scores.pixel_stride:
            known.scores = scores
        return known

    def find(self, number: int) -> Attempt:
        """A try by its number. Raises ConfigError if there is none."""
        if not 0 <= number < len(self.attempts):
            raise ConfigError(f"there is no try {number}")
        return self.attempts[number]

    def pin(self, number: int) -> None:
        """Make a try the reference. Raises ConfigError if there is none of that number."""
        self.pinned = self.find(number).number

    def file(self, kind: Literal["yaml", "csv"], number: int) -> tuple[str, str]:
        """Name and text of a file: the parameters of a try, or the table of all. Raises ConfigError if there
        is no try of that number."""
        if kind == "csv":
            return TABLE_FILE, self.to_csv()
        return f"try-{number}.yaml", self.to_yaml(number)

    def parameters(self) -> list[str]:
        """Names of all parameters in which some try differs from the first one."""
        names: dict[str, None] = {}
        for each in self.attempts:
            names |= dict.fromkeys(differences(self.attempts[0].config, each.config))
        return list(names)

    def to_yaml(self, number: int, comments: tuple[str, ...] = ()) -> str:
        """A try's parameters as YAML that ``map --config`` and ``live --config`` accept, with its scores and
        further ``comments`` as a comment at the head."""
        attempt = self.find(number)
        lines = [
            f"Found with taichi-mrf tune: try {attempt.number} of {self.source}.",
            *self._changes(attempt),
            "Scores on held-out views:",
            *(f"  {line}" for line in scores_in_words(attempt.scores)),
            *comments,
        ]
        head = "".join(f"# {' '.join(line.splitlines())}\n" for line in lines)
        return f"{head}\n{commented_yaml(attempt.config)}"

    def to_csv(self) -> str:
        """The table: a line for each try, with the parameters that were changed in any, and all scores in
        metres, seconds and shares of one."""
        names = self.parameters()
        kinds = [field.name for field in dataclasses.fields(Scores)]
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["try", "by", "reference", *names, *kinds])
        for each in self.attempts:
            values = [_plain(attrgetter(name)(each.config)) for name in names]
            scores = dataclasses.asdict(each.scores)
            is_reference = int(each.number == self.pinned)
            table.writerow([each.number, each.by, is_reference, *values, *(scores[kind] for kind in kinds)])
        return text.getvalue()

    def _changes(self, attempt: Attempt) -> list[str]:
        first = self.attempts[0].config
        changed = differences(first, attempt.config)
        if not changed:
            return ["The parameters are those that tuning began with."]
        return [
            "Changed from where tuning began:",
            *(f"  {n}: {attrgetter(n)(attempt.config)} (was {attrgetter(n)(first)})" for n in changed),
        ]


def _plain(value: Any) -> Any:
    return " ".join(map(str, value)) if isinstance(value, tuple) else value
