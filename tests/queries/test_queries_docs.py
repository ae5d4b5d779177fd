"""The examples of docs/queries.md, pasted one after the other."""

import re
from pathlib import Path

import pytest
from ball_room import room_that_changed
from pages import code_of
from queried_maps import room_map

import taichi_mrf
from taichi_mrf.cli.options.saved_maps import Export
from taichi_mrf.export.formats import FORMATS, export_map
from taichi_mrf.methods.mrf.reading import Layer


@pytest.fixture
def page(repository: Path) -> str:
    return (repository / "docs" / "queries.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("backend")
def test_the_examples_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    room_map("mrf").save(tmp_path / "map.npz")
    monkeypatch.chdir(tmp_path)
    examples = code_of(page)
    assert len(examples) == 15
    names: dict[str, object] = {}
    for example in examples:
        assert len([line for line in example.splitlines() if line]) <= 6
        exec(example, names)  # what the page tells people to run
    assert capsys.readouterr().out.count("\n") >= 5
    assert {path.name for path in tmp_path.iterdir()} == {"map.npz", "room.bt", "floor.pgm", "floor.yaml"}


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize("which", ["static", "dynamic"])
def test_the_examples_run_on_every_layer(
    which: Layer, page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layer = room_that_changed(ball_comes=True).layer(which)
    monkeypatch.setattr(taichi_mrf, "load_map", lambda path: layer)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for example in code_of(page):
        if "m.calibrated(" not in example:  # which needs the keyframes of a whole map
            exec(example, names)
    assert (tmp_path / "room.bt").stat().st_size > 0


def test_the_table_names_every_format(page: str) -> None:
    table = "\n".join(line for line in page.splitlines() if line.startswith("|"))
    assert all(f"`{extension}" in table for extension in FORMATS)


def test_help_docstring_and_readme_name_every_format(repository: Path) -> None:
    command = next(
        line for line in (repository / "README.md").read_text("utf-8").splitlines() if "--to" in line
    )
    extensions = FORMATS.keys() - {".yaml"}  # a part of .pgm
    for text in (command, Export.__doc__ or "", export_map.__doc__ or ""):
        assert not extensions - set(re.findall(r"\.[a-z]+", text))
