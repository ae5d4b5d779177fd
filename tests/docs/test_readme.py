"""The README: its first screen, and its first example as a user pastes it."""

import subprocess
import sys
from pathlib import Path

from pages import code_of


def test_the_example_runs(tmp_path: Path, repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    example = code_of(text)[0]
    # The same room on fewer pixels, and a folder that may be written to.
    program = example.replace("frames=20", "frames=4&width=160&height=120")
    program = program.replace('"map.npz"', repr(str(tmp_path / "map.npz")))
    assert program.count(str(tmp_path)) == program.count("width=160") == 1
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "voxels are occupied" in done.stdout
    assert (tmp_path / "map.npz").stat().st_size > 0


def test_the_first_screen_shows_a_picture_how_to_install_and_where_the_program_is(repository: Path) -> None:
    first_screen = "\n".join((repository / "README.md").read_text(encoding="utf-8").splitlines()[:30])
    for needed in ("![", "pip install", "make run ", "make test ", ".venv/bin/taichi-mrf", "taichi-mrf demo"):
        assert needed in first_screen, needed


def test_the_readme_is_short_and_its_table_is_that_of_the_evaluation(repository: Path) -> None:
    """Both tables have the columns scene, voxels, system and four figures; the README has fewer rows."""
    lines = (repository / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    measured = {}
    for line in (repository / "docs" / "evaluation.md").read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 7:
            measured.setdefault(tuple(cells[:3]), cells[3:])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    shown = {tuple(row[:3]): row[3:] for row in rows if len(row) == 7 and row[0] not in ("scene", "---")}
    assert len(shown) > 8
    assert shown == {key: measured[key] for key in shown}
