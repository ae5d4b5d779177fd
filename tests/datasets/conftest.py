"""What tests of readers share: a writer of bags."""

from collections.abc import Callable
from pathlib import Path

import pytest
from inputs_bags import Bag, Kind, writing


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., Path]:
    """Writes a bag of parts; returns its path. A second bag of the same name has a number behind it."""

    def write(*parts: Callable[[Bag], object], kind: Kind = "ros1", name: str = "walk") -> Path:
        suffix = ".bag" if kind == "ros1" else ""
        path = tmp_path / (name + suffix)
        if path.exists():
            path = tmp_path / f"{name}{len(list(tmp_path.iterdir()))}{suffix}"
        with writing(path, kind) as bag:
            for part in parts:
                part(bag)
        return path

    return write
