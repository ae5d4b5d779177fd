"""The README: its first screen, and its first example as a user pastes it."""

import re
import runpy
from pathlib import Path

from new_interpreter import python
from pages import code_of


def test_the_example_runs(tmp_path: Path, repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    example = code_of(text)[0]
    # The same room on fewer pixels, and a folder that may be written to.
    program = example.replace("frames=20", "frames=4&width=160&height=120")
    program = program.replace('"map.npz"', repr(str(tmp_path / "map.npz")))
    assert program.count(str(tmp_path)) == program.count("width=160") == 1
    done = python("-c", program)
    assert (done.returncode, done.stderr) == (0, "")
    assert "voxels are occupied" in done.stdout
    assert (tmp_path / "map.npz").stat().st_size > 0


def test_the_first_screen_shows_a_picture_how_to_install_and_where_the_program_is(repository: Path) -> None:
    first_screen = "\n".join((repository / "README.md").read_text(encoding="utf-8").splitlines()[:30])
    for needed in ("![", "pip install", "make run ", "make test ", ".venv/bin/taichi-mrf", "taichi-mrf demo"):
        assert needed in first_screen, needed


def test_the_readme_is_short(repository: Path) -> None:
    assert len((repository / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_figures_of_the_pages_are_those_of_the_result_files(repository: Path) -> None:
    tables = runpy.run_path(str(repository / "docs" / "result_tables.py"))
    filled, row_of = tables["filled"], tables["row_of"]
    files = [tables["read"](path) for path in tables["RESULTS"].glob("*.csv")]
    readme, *pages = [page.read_text(encoding="utf-8") for page in tables["PAGES"]]
    headers = re.findall(r"^(\|.*)\n\| ---", "\n".join(pages), re.MULTILINE)
    from_files = [row_of(columns) for columns, _ in files]
    of_words = ["| topic | result | command |", "| topic | type | subscribers |"]
    assert sorted(headers) == sorted([*of_words, *from_files])
    assert any(header in readme for header in from_files)
    for text in (readme, *pages):
        assert filled(text) == text
        for columns, rows in files:
            _, header, below = text.partition(f"{row_of(columns)}\n")
            told = [key for key in rows if f"\n{row_of(list(key))} " in below.partition("\n\n")[0]]
            assert not header or len(told) >= (9 if text is readme else len(rows)), columns
            for key in told:
                one = f"\n{row_of(list(key))} "
                wrong = text.replace(header + below, header + below.replace(one, f"{one}9", 1))
                assert wrong != text
                assert filled(wrong) == text


def test_the_command_of_the_peers_gives_the_figures_of_their_file(tmp_path: Path, repository: Path) -> None:
    header = "scene,voxels,system,5 ms,10 ms,20 ms,50 ms,150 ms,500 ms"
    row = "lidar,20 cm,wavemap,,,,0.412 / -1.20,0.493 / -0.90,0.878 / -0.71"
    (tmp_path / "peers_budgets.csv").write_text(f"{header}\n{row}\n")
    program = (
        "import pathlib, make_peers\n"
        f"print(make_peers.budgets(pathlib.Path({str(tmp_path / 'peers_budgets.csv')!r})))"
    )
    done = python("-c", program, cwd=repository / "docs")
    row = "{('lidar', '20 cm', 'wavemap'): ['-', '.493', '.878', '-.71']}\n"
    assert (done.returncode, done.stdout) == (0, row)
