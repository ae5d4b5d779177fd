"""Parts that tests of experiments share: small scenes on the disk."""

from pathlib import Path

import pytest
from small_scenes import make_data


@pytest.fixture(scope="session")
def data(one_backend: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small scenes that nobody changes."""
    return make_data(tmp_path_factory.mktemp("data"))
