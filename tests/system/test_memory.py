"""Asking for memory before it is taken."""

import pytest

from taichi_mrf.errors import CapacityError
from taichi_mrf.system import memory


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Answers of the system so far; it always has 1600 bytes free."""
    answers: list[int] = []

    def free() -> int:
        answers.append(1600)
        return 1600

    monkeypatch.setattr(memory, "available_bytes", free)
    monkeypatch.setattr(memory, "_allowance", memory._Allowance())
    return answers


def test_more_than_nine_tenths_of_what_is_free_is_refused(asked: list[int]) -> None:
    memory.check_memory(1440, "an array")
    with pytest.raises(CapacityError, match="an array would need"):
        memory.check_memory(1441, "an array")


def test_little_is_granted_without_asking_until_it_is_a_sixteenth_together(asked: list[int]) -> None:
    for _ in range(4):
        memory.check_memory(25, "an array")
    assert len(asked) == 1  # the first leaves (0.9 * 1600 - 25) / 16 = 88 bytes
    memory.check_memory(14, "an array")
    assert len(asked) == 2


def test_an_answer_is_not_relied_on_for_long(asked: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    memory.check_memory(1, "an array")
    now = memory.time.monotonic()
    monkeypatch.setattr(memory.time, "monotonic", lambda: now + 2)
    memory.check_memory(1, "an array")
    assert len(asked) == 2


def test_a_limit_of_ones_own_counts_instead(asked: list[int]) -> None:
    memory.check_memory(1e9, "an array", limit_gb=1.0)
    with pytest.raises(CapacityError):
        memory.check_memory(1.01e9, "an array", limit_gb=1.0)
    assert asked == []
