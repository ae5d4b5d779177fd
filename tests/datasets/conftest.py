"""Parts that tests of readers share."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from inputs_bags import write_bag


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., Path]:
    """Writes a bag of parts; returns its path."""
    return partial(write_bag, tmp_path)
