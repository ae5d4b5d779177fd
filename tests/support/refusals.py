"""Sources that cannot be opened, for the tests of readers."""

from pathlib import Path
from typing import Any

import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.errors import DatasetError, FrameError


def refused(source: str | Path, *words: str, **options: Any) -> str:
    """What is said of a source that cannot be opened: one line, which holds these words."""
    with pytest.raises(DatasetError) as caught:
        open_dataset(source, **options)
    assert not isinstance(caught.value, FrameError)
    said = str(caught.value)
    assert "\n" not in said
    for each in words:
        assert each in said
    return said
