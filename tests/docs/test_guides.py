"""The guides for a newcomer, walked as they are printed, with smaller images and fewer of them."""

import re
import runpy
import shlex
from pathlib import Path

import numpy as np
import pytest
from console import taichi_mrf
from pages import code_of

SIZE = ("frames=30&width=160&height=120", "frames=12&width=80&height=60")
VOXELS = ("0.02", "0.1")


def blocks(repository: Path, page: str, kind: str) -> list[str]:
    """The page's blocks of code of a kind, "python" or, of shell commands, "", made small."""
    text = (repository / "docs" / page).read_text(encoding="utf-8")
    return [code.replace(*SIZE).replace(*VOXELS) for code in code_of(text, kind)]


@pytest.mark.usefixtures("one_backend")
def test_own_camera(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    programs = blocks(repository, "own_camera.md", "python")
    assert sum(SIZE[1] in program for program in programs) == 1
    for program in programs:
        Path(program.split()[1]).write_text(program)  # their first lines are their names
    runpy.run_path("record.py")
    assert "Open http://127.0.0.1" in capsys.readouterr().out
    assert np.load("walk.npz")["color"].shape == (12, 60, 80, 3)
    walked = []
    for line in "".join(blocks(repository, "own_camera.md", "")).splitlines():
        program, command, *arguments = shlex.split(line)
        if program == "taichi-mrf":
            if command in ("demo", "live"):  # Ctrl-C would end them
                arguments += ["--exit-when-done", "--port", "0", "--limit", "2"]
                arguments += ["--no-open", "--voxel-size", "0.2"] if command == "demo" else []
            done = taichi_mrf(command, *arguments)
            assert done.returncode == 0, (line, done.stderr)
            walked.append(command)
    assert set(walked) == {"demo", "info", "doctor", "map", "export", "live"}
    pictures = ["overlap.png", *(f"runs/walk/{name}.png" for name in ("surface", "top_view", "depth"))]
    for name in [*pictures, "runs/learnt/sensor.yaml", "room.ply", "room.glb"]:
        assert Path(name).stat().st_size > 0


@pytest.mark.usefixtures("one_backend")
def test_own_robot(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for program in blocks(repository, "own_robot.md", "python"):
        exec(program, names)
    printed = capsys.readouterr().out
    assert printed.startswith("True\n")
    met = re.search(r"(\d+) of 72 rays", printed)
    assert met is not None
    assert int(met[1]) > 10
    assert {path.name for path in tmp_path.iterdir()} == {"floor.pgm", "floor.yaml"}


@pytest.mark.usefixtures("one_backend")
def test_the_numbers_of_how_it_works_are_those_of_its_figure(repository: Path) -> None:
    figure = runpy.run_path(str(repository / "docs" / "make_how_it_works.py"))
    page = " ".join((repository / "docs" / "how_it_works.md").read_text(encoding="utf-8").split())
    wall = np.argmin(np.abs(figure["ALONG_M"] - figure["WALL_M"]))
    after = figure["noisy_wall"](figure["tm"].MRFMap(figure["VOXEL_M"], noise=figure["NOISE"]))
    one, three, ten = (f"{after[count][wall]:.1f}" for count in figure["COUNTS"])
    assert f"{one} after one keyframe, {three} after three and {ten} after ten" in page
    octomap = figure["noisy_wall"](figure["tm"].LogOddsMap(figure["VOXEL_M"]))
    assert f"{(octomap[figure['COUNTS'][-1]] > 0.5).sum()} voxels stay above 0.5" in page
    message = figure["one_ray"]()
    assert f"{message.min():.1f} is a thousand to one" in page
    assert message[wall] > 0
    assert np.abs(message[wall + 5 :]).max() < 0.01
