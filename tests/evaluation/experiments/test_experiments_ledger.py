"""The ledger of an experiment: what is found once is never computed again, and never mixed with others'."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refusal

from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.evaluation.experiments.ledger import Ledger

MADE_WITH = {"version": "1", "backend": "cpu"}
RESULTS = {f"fold {i}": {"score": i / 3, "none": None, "nested": {"a": [1, 2.5]}} for i in range(3)}


def never() -> dict[str, Any]:
    raise AssertionError("computed again")


def filled(path: Path) -> Ledger:
    ledger = Ledger(path, MADE_WITH)
    for key, result in RESULTS.items():
        ledger.result(key, lambda r=result: r)
    return ledger


def test_what_was_found_is_found_again(tmp_path: Path) -> None:
    first = filled(tmp_path / "l.jsonl")
    assert first.computed == 3
    assert first.result("fold 1", never) == RESULTS["fold 1"]
    again = Ledger(tmp_path / "l.jsonl", dict(reversed(MADE_WITH.items())))
    assert {key: again.result(key, never) for key in RESULTS} == RESULTS
    assert again.computed == 0


def test_a_result_is_the_same_when_it_was_just_found_and_when_it_is_read(tmp_path: Path) -> None:
    found = {"pair": (1, 2), 3: "a key that JSON turns into text", "nan": math.nan, "inf": math.inf}
    now = Ledger(tmp_path / "l.jsonl", MADE_WITH).result("key", lambda: found)
    later = Ledger(tmp_path / "l.jsonl", MADE_WITH).result("key", never)
    assert math.isnan(now.pop("nan"))
    assert math.isnan(later.pop("nan"))
    assert now == later == {"pair": [1, 2], "3": found[3], "inf": math.inf}


@given(lost=st.integers(min_value=1, max_value=400))
def test_a_killed_run_loses_no_more_than_what_it_was_writing(
    tmp_path_factory: pytest.TempPathFactory, lost: int
) -> None:
    path = tmp_path_factory.mktemp("ledger") / "l.jsonl"
    filled(path)
    whole = path.read_bytes()
    left = whole[:-lost]
    path.write_bytes(left)
    ledger = Ledger(path, MADE_WITH)
    # Without its newline a line is whole as well.
    expected = sum(left.startswith(whole[: whole.find(f'"{key}"'.encode())]) for key in RESULTS)
    assert expected - 1 <= len(ledger.done) <= expected
    assert all(ledger.done[key] == RESULTS[key] for key in ledger.done)
    missing = len(RESULTS) - len(ledger.done)
    for key, result in RESULTS.items():
        ledger.result(key, lambda r=result: r)
    assert ledger.computed == missing
    assert path.read_bytes() == whole


def test_half_a_line_is_cut_off_the_file_at_once(tmp_path: Path) -> None:
    path = tmp_path / "l.jsonl"
    filled(path)
    whole = path.read_text()
    path.write_text(whole + '{"key": "fold 3", "resu')
    assert len(Ledger(path, MADE_WITH).done) == 3
    assert path.read_text() == whole


def test_a_failed_computation_leaves_nothing(tmp_path: Path) -> None:
    ledger = filled(tmp_path / "l.jsonl")
    before = ledger.path.read_bytes()
    with pytest.raises(AssertionError, match="computed again"):
        ledger.result("fold 7", never)
    assert ledger.path.read_bytes() == before
    assert "fold 7" not in ledger.done


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"made_with": {"version": "2", "backend": "cpu"}}) + "\n",
        json.dumps({"key": "fold 0", "result": {}}) + "\n",
        "notes of somebody\n",
    ],
    ids=["other parameters", "no head", "another file"],
)
def test_other_results_are_refused_and_left_alone(tmp_path: Path, text: str) -> None:
    path = tmp_path / "l.jsonl"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"l\.jsonl: .* another version; choose another folder") as caught:
        Ledger(path, MADE_WITH)
    assert "\n" not in str(caught.value)
    assert path.read_text() == text


def test_a_file_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "folder.jsonl").mkdir()
    (tmp_path / "binary.jsonl").write_bytes(b"\xff\xfe\x00")
    for name in ("folder.jsonl", "binary.jsonl"):
        with refusal(MapFileError, f"{name}: cannot be read"):
            Ledger(tmp_path / name, MADE_WITH)
    with pytest.raises(MapFileError, match=r"no/l\.jsonl: cannot be written"):
        Ledger(tmp_path / "no" / "l.jsonl", MADE_WITH)


def test_a_result_that_cannot_be_kept_names_the_file(tmp_path: Path) -> None:
    ledger = filled(tmp_path / "l.jsonl")
    ledger.path.unlink()
    ledger.path.mkdir()
    with pytest.raises(MapFileError, match=r"l\.jsonl: cannot be written"):
        ledger.result("fold 7", dict)
