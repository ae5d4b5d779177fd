"""A disk that becomes full in the middle of a file."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

resource = pytest.importorskip("resource", reason="file-size limits are a POSIX feature")


@contextmanager
def files_up_to(size_bytes: int) -> Iterator[None]:
    """No file of this process can grow further. Not for a whole test, in which pytest writes to what may be a
    file."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
