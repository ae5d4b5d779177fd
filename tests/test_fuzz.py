"""Damaged input of every kind: one line that names it, or what can rightly be read of it; never a crash.
Which file of a good input is damaged and how follows from a seed. A case ends in an outcome, or a failure:

    refused   one line of this package's that names a file or a frame
    same      what is read is what was there: the damage is in nothing that counts
    other     something else is read, and it is sound: the damaged file says so, and nothing in its format
              can tell. Never so in a format with checksums
"""

import faulthandler
import random
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from fuzz_damage import BYTES, PNG, TEXT, ZIP, Damage
from fuzz_loaders import LOADERS, RECORDINGS, map_last_dataset
from hypothesis import given, settings
from hypothesis import strategies as st
from inputs_bags import plain, write_bag

from taichi_mrf.datasets.entries import FORMATS
from taichi_mrf.datasets.registry import format_name, open_dataset, plugs
from taichi_mrf.errors import DatasetError, TaichiMRFError

pytestmark = pytest.mark.usefixtures("one_backend")

TEXT_SUFFIXES = (".txt", ".json", ".yaml", ".log", ".freiburg", ".ply", ".pcd", ".csv", ".g2o")
LONGEST_LINE = 2000
BY_NAME = {loader.name: loader for loader in LOADERS}


class FuzzError(AssertionError):
    """Outcomes that a damaged file must not have."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case; ``said`` is the error's text."""

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


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("name", [loader.name for loader in LOADERS])
@settings(max_examples=8, derandomize=True, database=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_file_is_refused_or_read_rightly(name: str, seed: int, root: Path) -> None:
    run_case(name, seed, root)


@pytest.fixture
def bounded() -> Iterator[None]:
    """A case that takes 3 GB more than this process holds now is out of memory; one that takes longer than a
    minute ends the run."""
    resource = pytest.importorskip("resource", reason="limits are a POSIX feature")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + 3_000_000_000, limits[1]))
    yield
    faulthandler.cancel_dump_traceback_later()
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.mark.soak
@pytest.mark.parametrize("name", [loader.name for loader in LOADERS])
def test_many_damaged_files_are_refused_or_read_rightly(name: str, root: Path, bounded: None) -> None:
    """Other ones each time; a failure names its seed."""
    for _ in range(300):
        faulthandler.dump_traceback_later(60.0, exit=True)
        run_case(name, random.randrange(2**32), root)


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("map, MRFMap", 20682),  # a character beyond Unicode
        ("tum", 21517),  # a file name of thousands of characters
        ("tum", 22406),  # a folder's
        ("MCAP", 22624),  # a word for a number in the metadata
        ("mesh PLY", 20692),  # a word of thousands of characters, which the reader of meshes repeats
    ],
)
def test_what_once_went_wrong_is_refused(name: str, seed: int, root: Path) -> None:
    assert run_case(name, seed, root).kind == "refused"


def test_every_format_of_recordings_is_damaged_here(root: Path) -> None:
    written = {format_name(root / f"good {name}" / _good(name, root)[0]) for name in RECORDINGS}
    by_a_library = {"Ouster", "LAS survey"}  # which not every machine has
    missing = {each.name for each in (*plugs()[0], *FORMATS)} - written - by_a_library
    assert not missing, f"write {missing} in FORMATS of tests/support/datasets_recordings.py"


def test_an_index_that_points_to_another_topics_message_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path, plain)
    opening = b"op=\x04\x08\x00\x00\x00ver=\x01\x00\x00\x00\t\x00\x00\x00conn="
    first, second = (opening + bytes((topic, 0, 0, 0)) for topic in range(2))
    content = path.read_bytes()
    assert content.count(first) == 1
    path.write_bytes(content.replace(first, second))
    with pytest.raises(DatasetError, match="cannot be read: contains a sensor_msgs/msg/CameraInfo"):
        open_dataset(path)
