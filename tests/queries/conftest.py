"""Parts that tests of queries share: maps made by hand, which nobody changes."""

import pytest
from hand_made import HandMade, made_at_random
from queried_maps import HandMap, hand_map


@pytest.fixture(scope="session")
def hand(backend: str) -> HandMap:
    return hand_map(backend)


@pytest.fixture(scope="session")
def random_map(backend: str) -> HandMade:
    return made_at_random(backend)
