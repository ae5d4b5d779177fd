"""The table of CONTRIBUTING.md names files that exist, and what it says of tests holds."""

import re
from pathlib import Path

from datasets_recordings import FORMATS as WRITERS
from every_format import EVERY
from fuzz_loaders import RECORDINGS


def test_its_paths_exist(repository: Path) -> None:
    text = (repository / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z_]+/[\w./]+)`", text))
    assert {"taichi_mrf/datasets/entries.py", "tests/support/datasets_recordings.py"} <= named
    assert not [name for name in named if not (repository / name).exists()]


def test_a_writer_of_a_format_is_in_every_test_of_formats() -> None:
    assert WRITERS.keys() <= EVERY.keys()
    assert WRITERS.keys() <= set(RECORDINGS)
