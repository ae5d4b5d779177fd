"""Parts that tests of readers share."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from heard import begun
from inputs_bags import Bag, Kind, write_bag
from rosbags.serde import cdr, ros1, utils

from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.wires import robot as wired


@pytest.fixture(scope="session", autouse=True)
def compiled_once() -> Iterator[None]:
    """rosbags compiles code for each type of each bag, a quarter of what tests of bags take."""

    @cache
    def compiled(*lines: str) -> ModuleType:
        return utils.compile_lines(list(lines))

    with pytest.MonkeyPatch.context() as patch:
        for module in (cdr, ros1):
            patch.setattr(module, "compile_lines", lambda lines: compiled(*lines))
        yield


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., Path]:
    """Writes a bag of parts; returns its path."""
    return partial(write_bag, tmp_path)


@pytest.fixture
def begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """Opens a robot that sends its ``first`` messages while it is listened to. Returns the robot, the dataset
    and the bag of all that it sends."""
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from foxglove_robot import Robot

    monkeypatch.setattr(wired, "LISTEN_S", 0.5)
    monkeypatch.setattr(wired, "DECIDE_S", 0.3)
    with ExitStack() as stack:

        def begin_one(
            *parts: Callable[[Bag], object],
            query: str = "",
            first: int = 1000,
            kind: Kind = "mcap",
            color: bool = False,
            listen_to: str = "/tf_static",
        ) -> tuple[Any, Dataset, Path]:
            bag = write_bag(tmp_path, *parts, kind=kind)
            sender = stack.enter_context(Robot(bag))
            return sender, begun(sender, first, query, listen_to, color), bag

        yield begin_one
