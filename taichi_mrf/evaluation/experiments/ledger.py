"""Results that are kept as soon as they are found, so that an interrupted experiment goes on where it was.

One line of JSON for each result. The first line says which program and parameters they were made with;
results of others are not mixed in.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taichi_mrf.errors import ConfigError, MapFileError

Result = dict[str, Any]


class Ledger:
    """The results of one experiment. Each has a key: what was mapped and judged, in words."""

    def __init__(self, path: Path, made_with: dict[str, Any]) -> None:
        """Read what a run before has left, and go on behind it. ``made_with`` is plain JSON values.

        Raises ConfigError if the file was made with something else, MapFileError if it cannot be used.
        """
        self.path = path
        self.done: dict[str, Result] = {}
        self.computed = 0
        head = json.dumps({"made_with": made_with}, sort_keys=True)
        try:
            lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
            # A run that was killed may have left half of its last line.
            whole = [line for line in lines if _is_whole(line)]
            if whole and whole[0] != head:
                raise ConfigError(
                    f"{path}: holds results made with other parameters or another version; "
                    "choose another folder, or delete the file"
                )
            for line in whole[1:]:
                entry = json.loads(line)
                self.done[entry["key"]] = entry["result"]
            if whole != lines or not whole:
                path.write_text("".join(f"{line}\n" for line in whole or [head]), encoding="utf-8")
        except OSError as error:
            raise MapFileError(f"{path}: {error.strerror or error}") from error

    def result(self, key: str, compute: Callable[[], Result]) -> Result:
        """What is known under a key; computed and written down if nothing is yet."""
        if key not in self.done:
            found = compute()
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "result": found}) + "\n")
            # As a later run will read it, so that both give the same tables.
            self.done[key] = json.loads(json.dumps(found))
            self.computed += 1
        return self.done[key]


def _is_whole(line: str) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True
