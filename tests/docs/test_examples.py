"""Every example runs as it stands, and says what it is meant to show."""

import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from new_interpreter import python

from taichi_mrf.session import own_loop

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("[0-9]*.py"))


def printed(path: Path, folder: Path) -> str:
    done = python(path, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_they_are_numbered_from_one() -> None:
    assert [path.name[:2] for path in EXAMPLES] == [f"{n:02d}" for n in range(1, len(EXAMPLES) + 1)]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_to_start_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert 30 <= len(text.splitlines()) <= 150
    assert f"python examples/{path.name}" in text


def test_own_camera(tmp_path: Path) -> None:
    out = printed(EXAMPLES[0], tmp_path)
    for line in ("[0.0, 0.0, 1.0] is free", "[0.0, 0.0, 3.02] is occupied", "[0.0, 0.0, 5.0] is unknown"):
        assert line in out
    assert (tmp_path / "own_camera.npz").exists()


def test_own_sensor_model(tmp_path: Path) -> None:
    out = printed(EXAMPLES[1], tmp_path)
    errors = [abs(float(value)) for value in re.findall(r"wall is ([+-][0-9.]+) cm", out)]
    right = [int(value) for value in re.findall(r"([0-9]+)% of the pixels", out)]
    assert errors[2] < 1 < errors[1]
    assert right[2] > 90 > 10 > right[1]


def test_planner_query(tmp_path: Path) -> None:
    out = printed(EXAMPLES[2], tmp_path)
    assert "the straight path of 2.34 m is clear" in out
    assert 0.3 < float(re.findall(r"clearance is ([0-9.]+) m", out)[0]) < 1.0
    met, unknown = map(int, re.findall(r"([0-9]+) of 360 rays meet a surface, ([0-9]+) end", out)[0])
    assert met > 180
    assert met + unknown == 360


def test_next_best_view(tmp_path: Path) -> None:
    by_gain, in_order = map(
        int, re.findall(r"([0-9]+)% by gain, ([0-9]+)%", printed(EXAMPLES[4], tmp_path))[0]
    )
    assert by_gain > in_order + 10


def test_loop_closure(tmp_path: Path) -> None:
    before, after = printed(EXAMPLES[3], tmp_path).splitlines()[-2:]
    assert "100.0% of the occupied voxels shared, largest difference 0.000" in after
    assert float(re.findall(r"([0-9.]+)%", before)[0]) < 90


def test_comparing_methods(tmp_path: Path) -> None:
    rows = {
        row[0].strip(): [float(value) for value in row[1:]]
        for row in re.findall(
            r"^(.{24}) +([0-9.]+) +([0-9.]+) +([0-9]+)$", printed(EXAMPLES[5], tmp_path), re.M
        )
    }
    baselines = (rows["OctoMap-style log-odds"][1], rows["visibility map"][1])
    assert rows["MRFMap"][1] > max(baselines)


@pytest.mark.usefixtures("one_backend")
def test_notebook(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(own_loop, "_in_notebook", lambda: True)
    plt.switch_backend("agg")
    cells = json.loads((EXAMPLES[0].parent / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert not cell["outputs"]
            exec("".join(cell["source"]), names)
    plt.close("all")
    printed = capsys.readouterr().out
    assert "10 keyframes:" in printed
    assert int(re.findall(r"([0-9]+)% of the pixels right", printed)[0]) > 75
    assert (tmp_path / "room.npz").exists()


def test_every_example_is_in_the_index() -> None:
    index = (EXAMPLES[0].parent / "README.md").read_text(encoding="utf-8")
    assert not [path.name for path in EXAMPLES if f"({path.name})" not in index]
