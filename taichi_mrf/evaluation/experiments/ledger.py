"""Results that are kept as soon as they are found, so that an interrupted experiment goes on where it was.

One line of JSON for each result. The first line names the program and the parameters that they were made
with; results of others are not mixed in.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.system.atomic import write_text

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
            text = path.read_text(encoding="utf-8") if path.exists() else ""
        except (OSError, UnicodeDecodeError) as error:
            raise MapFileError(
                f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
            ) from error
        # A run that was killed may have left half of its last line.
        whole = [line for line in text.splitlines() if _is_whole(line)]
        if not (whole[0] == head if whole else head.startswith(text)):
            raise ConfigError(
                f"{path}: holds no results, or such made with other parameters or another version; "
                "choose another folder, or delete the file"
            )
        for line in whole[1:]:
            entry = json.loads(line)
            self.done[entry["key"]] = entry["result"]
        kept = "".join(f"{line}\n" for line in whole or [head])
        if kept != text:
            write_text(path, kept)

    def result(self, key: str, compute: Callable[[], Result]) -> Result:
        """Result under a key; computed and written down if there is none yet. Raises MapFileError."""
        if key not in self.done:
            found = compute()
            line = json.dumps({"key": key, "result": found}) + "\n"
            try:
                with open(self.path, "a", encoding="utf-8") as file:
                    file.write(line)
            except OSError as error:
                raise MapFileError(f"{self.path}: cannot be written: {error.strerror or error}") from error
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
