"""Output of the program: control characters as escapes, progress as lines where there is no terminal."""

import io
import logging
import re
from pathlib import Path

import pytest
from console import COARSE, ROOM, assert_refused, taichi_mrf
from rich.table import Table

import taichi_mrf as package
from taichi_mrf.cli.options.shared import Verbosity
from taichi_mrf.cli.shared import progress
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal, printable

HOSTILE = "a\x1b]0;owned\x07\x1b[2J\u202eb\udcff"
FAST_ROOM = ("map", ROOM, "--limit", "2", "--no-pictures", *COARSE)


def printed(terminal: Terminal) -> str:
    assert isinstance(terminal.file, io.StringIO)
    return terminal.file.getvalue()


@pytest.fixture
def terminal() -> Terminal:
    terminal = Terminal()
    terminal.file = io.StringIO()
    return terminal


def test_control_characters_become_escapes(terminal: Terminal) -> None:
    assert printable(HOSTILE) == r"a\x1b]0;owned\x07\x1b[2J\u202eb\udcff"
    assert printable("two\n\tlines, σ") == "two\n\tlines, σ"
    table = Table("name [bold]", title=HOSTILE)
    table.add_row(HOSTILE)
    terminal.print(table)
    terminal.print_line(f"[red]{HOSTILE}")
    text = printed(terminal)
    assert text.count(r"\x1b]0;owned") == 3
    assert "[bold]" in text
    assert "[red]" in text
    assert text.replace("\n", "").isprintable()


def test_only_one_module_opens_the_terminal() -> None:
    """And start.py, which cannot load it where rich is missing, and prints nothing that comes from data."""
    folder = Path(package.__file__).parent / "cli"
    assert not [
        path
        for path in folder.rglob("*.py")
        if path.name not in ("terminal.py", "start.py")
        and re.search(r"\bConsole\(|file=sys\.stderr", path.read_text())
    ]


def test_a_key_of_a_yaml_file_and_a_file_name_reach_no_terminal(tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text('"a\\e[31mb": 1\n')
    done = taichi_mrf("map", ROOM, "--out", tmp_path / "out", "--config", tmp_path / "my.yaml")
    assert_refused(done, r"a\x1b[31mb")
    done = taichi_mrf("info", "no\x1b[31m\nsuch")
    assert_refused(done, r"no\x1b[31m\nsuch")
    assert "\x1b" not in done.stderr


def test_without_a_terminal_there_is_a_line_on_stderr_every_few_seconds(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with ProgressBar(terminal) as bar:
        for number in range(1, 13):
            now = float(number)
            bar.advance("Adding", number, 12, keyframes=1)
    assert printed(terminal) == ""
    assert capsys.readouterr().err.splitlines() == [
        "Adding 5 of 12, 1.2 keyframes/s",
        "Adding 10 of 12, 1.1 keyframes/s",
    ]


def test_verbose_is_a_line_for_every_step(terminal: Terminal, capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressBar(terminal, Verbosity(verbose=True)) as bar:
        for number in range(3):
            bar.advance("Drawing", number, None, note="x")
    assert printed(terminal) == ""
    assert capsys.readouterr().err == "Drawing 0, x\nDrawing 1, x\nDrawing 2, x\n"


def test_a_reader_that_has_gone_does_not_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(Verbosity())

    def broken(self: Terminal, text: str) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(Terminal, "print_line", broken)
    with ProgressBar(terminal, Verbosity(verbose=True)) as bar:
        bar.advance("Adding", 1, 2)


def test_verbose_shows_the_log(capsys: pytest.CaptureFixture[str]) -> None:
    log = logging.getLogger("taichi_mrf.system.runtime")
    for verbosity in (Verbosity(verbose=True), Verbosity()):
        open_terminal(verbosity)
        log.info("Taichi runs on a\x1btoaster")
    assert capsys.readouterr() == ("", "Taichi runs on a\\x1btoaster\n")


def test_quiet_and_verbose_runs(tmp_path: Path) -> None:
    quiet = taichi_mrf(*FAST_ROOM, "--out", tmp_path / "a", "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    verbose = taichi_mrf(*FAST_ROOM, "--out", tmp_path / "b", "--verbose")
    assert verbose.returncode == 0
    assert "Adding 2 of 2" in verbose.stderr
    assert "Adding" not in verbose.stdout
    assert_refused(
        taichi_mrf(*FAST_ROOM, "--out", tmp_path / "c", "--quiet", "--verbose"), "cannot be combined"
    )
