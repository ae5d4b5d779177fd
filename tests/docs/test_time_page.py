"""The examples of docs/time.md, pasted one after the other, and its table of parameters."""

import dataclasses
import re
from pathlib import Path

import pytest
from pages import code_of

from taichi_mrf.config.sections import TimeConfig


@pytest.fixture
def page(repository: Path) -> str:
    return (repository / "docs" / "time.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("one_backend")
def test_the_examples_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for example in code_of(page):
        exec(example.replace('tm.init("cpu")\n', ""), names)  # what the page tells people to run
    appeared, vanished, new, gone = (
        int(number) for number in re.findall(r"\d+", capsys.readouterr().out.split("\n", 1)[1])
    )
    assert min(appeared, vanished, new, gone) > 20
    assert {path.name for path in tmp_path.iterdir()} == {"moved.ply", "room.ply"}


def test_the_table_has_every_parameter(page: str) -> None:
    for field in dataclasses.fields(TimeConfig):
        assert f"| `time.{field.name}` | {field.default:g} |" in page
