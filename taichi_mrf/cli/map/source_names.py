"""Names of folders for the results of several sources."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from taichi_mrf.errors import ConfigError
from taichi_mrf.system.files import exists, is_folder


def folder_names(sources: Sequence[str]) -> list[str]:
    """A name for each source: the last part of its path, or a built-in's name; where that is not enough to
    tell them apart, more of the path or the options after the question mark; at last numbers.

    The same sources always give the same names, which differ in more than upper and lower case. Raises
    ConfigError if a source is there twice.
    """
    twice = [source for source, count in Counter(sources).items() if count > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: is named twice")
    choices = [_from_short_to_long(source) for source in sources]
    lengths = [0] * len(sources)
    while True:
        names = [choice[length] for choice, length in zip(choices, lengths, strict=True)]
        counts = Counter(name.casefold() for name in names)
        longer = [
            number
            for number, name in enumerate(names)
            if counts[name.casefold()] > 1 and lengths[number] + 1 < len(choices[number])
        ]
        if not longer:
            return _numbered(names)
        for number in longer:
            lengths[number] += 1


def _from_short_to_long(source: str) -> list[str]:
    """Possible names of the source."""
    path, mark, _ = source.partition("?")
    if exists(Path(source)):
        path, mark = source, ""
    folder = Path(path)
    if folder.name in ("", ".."):
        folder = folder.resolve()
    last = folder.name if is_folder(folder) else folder.stem
    parts = [*(part for part in folder.parent.parts if part != ".."), last]
    names = [_plain("_".join(parts[-count:])) for count in range(1, len(parts) + 1)]
    return [*names, _plain(source)] if mark else names


def _plain(text: str) -> str:
    """The text with nothing in it that a file system or a shell could mind."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("._") or "sequence"


def _numbered(names: list[str]) -> list[str]:
    """The names, with a number behind those that are taken already."""
    taken: set[str] = {name.casefold() for name in names}
    used: set[str] = set()
    unique = []
    for name in names:
        candidate, number = name, 2
        while candidate.casefold() in used or (candidate != name and candidate.casefold() in taken):
            candidate, number = f"{name}_{number}", number + 1
        used.add(candidate.casefold())
        unique.append(candidate)
    return unique
