"""The examples of the API page are one program that runs as it stands."""

import re
import runpy
from pathlib import Path

import pytest

from taichi_mrf.session.own_loop import LivePage


@pytest.mark.usefixtures("one_backend")
def test_the_examples_run(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LivePage, "serve", LivePage.update)  # tm.show would wait for Ctrl-C
    with pytest.warns(UserWarning, match="the map is at http"):
        runpy.run_path(str(repository / "docs" / "api_examples.py"))
    printed = capsys.readouterr().out
    assert "nowhere.npz: there is no such file" in printed
    right = re.search(r"([0-9]+)% of the pixels", printed)
    assert right is not None
    assert int(right[1]) > 80
