"""One case of the fuzz test: which file of a good input is damaged and how follows from a seed; what comes of
it is an outcome, or a failure.

    refused   one line of this package's that names a file or a frame
    same      what is read is what was there: the damage is in nothing that counts
    other     something else is read, and it is sound: the damaged file says so, and nothing in its format
              can tell. Never so in a format with checksums
"""

import random
import shutil
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fuzz_damage import BYTES, PNG, TEXT, ZIP, Damage
from fuzz_loaders import LOADERS, map_last_dataset

from taichi_mrf.errors import TaichiMRFError

TEXT_SUFFIXES = (".txt", ".json", ".yaml", ".log", ".freiburg", ".ply", ".pcd", ".csv", ".g2o")
LONGEST_LINE = 2000
BY_NAME = {loader.name: loader for loader in LOADERS}


class FuzzError(AssertionError):
    """What must not come of a damaged file."""


@dataclass(frozen=True)
class Outcome:
    """What came of a case; ``said`` is the error's text."""

    kind: str
    file: str
    damage: str
    said: str = ""


@cache
def _good(name: str, root: Path) -> tuple[Path, bytes]:
    """A good input, written once, and what is read of it."""
    loader = BY_NAME[name]
    folder = root / f"good {name}"
    folder.mkdir(parents=True)
    path = loader.make(folder)
    return path.relative_to(folder), loader.read(path)


def run_case(name: str, seed: int, root: Path) -> Outcome:
    """Damage one file of a copy of a loader's good input and read it. Raises FuzzError."""
    loader, draw = BY_NAME[name], random.Random(seed)
    place, content = _good(name, root)
    folder = root / "case"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(root / f"good {name}", folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    file = draw.choice(files)
    damage = draw.choice(_damages(draw, file))
    file.write_bytes(damage(draw, file.read_bytes()))
    case = f"{name}, seed {seed}: {file.relative_to(folder)} {damage.__name__}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # odd numbers make NumPy warn where they are looked at
            found = loader.read(folder / place)
            if found != content:
                map_last_dataset()
    except TaichiMRFError as error:
        _check_words(case, str(error), folder)
        return Outcome("refused", file.name, damage.__name__, str(error))
    except Exception as error:
        raise FuzzError(f"{case}: {type(error).__name__}: {error}") from error
    if found == content:
        return Outcome("same", file.name, damage.__name__)
    if loader.sealed and damage in BYTES:
        raise FuzzError(f"{case}: something else was read")
    return Outcome("other", file.name, damage.__name__)


def _damages(draw: random.Random, file: Path) -> list[Damage]:
    """The kinds of damage to choose from: as often to the bytes as to what they say."""
    ways = {".npz": ZIP, ".png": PNG, **dict.fromkeys(TEXT_SUFFIXES, TEXT)}.get(file.suffix)
    return ways if ways and draw.random() < 0.5 else BYTES


def _check_words(case: str, said: str, folder: Path) -> None:
    if "\n" in said or len(said) > LONGEST_LINE:
        raise FuzzError(f"{case}: not one line: {said[:300]!r}")
    if str(folder) not in said:
        raise FuzzError(f"{case}: names no file: {said}")
