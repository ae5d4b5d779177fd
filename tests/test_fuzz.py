"""Damaged input of every kind: one line that names it, or what can rightly be read of it; never a crash."""

import faulthandler
import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz_case import run_case
from fuzz_loaders import LOADERS
from hypothesis import given, settings
from hypothesis import strategies as st
from inputs_bags import plain, write_bag

from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.errors import DatasetError

pytestmark = pytest.mark.usefixtures("one_backend")


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
        ("TUM RGB-D", 21517),  # a file name of thousands of characters
        ("TUM RGB-D", 22406),  # a folder's
        ("MCAP", 22624),  # a word for a number in the metadata
        ("mesh PLY", 20692),  # a word of thousands of characters, which the reader of meshes repeats
    ],
)
def test_what_once_went_wrong_is_refused(name: str, seed: int, root: Path) -> None:
    assert run_case(name, seed, root).kind == "refused"


def test_an_index_that_points_to_another_topics_message_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path, plain)
    opening = b"op=\x04\x08\x00\x00\x00ver=\x01\x00\x00\x00\t\x00\x00\x00conn="
    first, second = (opening + bytes((topic, 0, 0, 0)) for topic in range(2))
    content = path.read_bytes()
    assert content.count(first) == 1
    path.write_bytes(content.replace(first, second))
    with pytest.raises(DatasetError, match="cannot be read: contains a sensor_msgs/msg/CameraInfo"):
        open_dataset(path)
