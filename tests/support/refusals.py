"""Errors in one line, and sources that cannot be opened."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.errors import DatasetError, FrameError, TaichiMRFError


@contextmanager
def refusal(kind: type[TaichiMRFError], *words: str) -> Iterator[pytest.ExceptionInfo[TaichiMRFError]]:
    """All that is done here is refused in one line, which holds these words."""
    with pytest.raises(kind) as caught:
        yield caught
    said = str(caught.value)
    assert "\n" not in said
    for each in words:
        assert each in said


def refused(source: str | Path, *words: str, **options: Any) -> str:
    """Error for a source that cannot be opened: one line, which holds these words."""
    with refusal(DatasetError, *words) as caught:
        open_dataset(source, **options)
    assert not isinstance(caught.value, FrameError)
    return str(caught.value)


def bad_frame(dataset: Dataset, index: int, *words: str) -> str:
    """Error for a frame that cannot be read: one line with these words, begun with its name."""
    with refusal(FrameError, *words) as caught:
        dataset.read(index)
    assert str(caught.value).startswith(f"frame {dataset.frame_names[index]}: ")
    return str(caught.value)
