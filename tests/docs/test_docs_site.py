"""The documentation site is built without a warning, names every parameter, and its pictures have makers."""

import dataclasses
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from taichi_mrf.config.schema import Config
from taichi_mrf.factor_graph.config import LaserConfig


def names(section: Any, prefix: str = "") -> Iterator[str]:
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from names(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def test_the_site_is_built_without_a_warning(repository: Path, tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=repository, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "parameters" / "index.html").read_text(encoding="utf-8")
    for name in [*names(Config()), *names(LaserConfig())]:
        assert f"<code>{name}</code>" in page
    front = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "taichi-mrf live" in front
    assert 'href="live/"' in front


PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")


def test_pictures_are_there_are_shown_and_come_from_a_script_or_a_command(repository: Path) -> None:
    pages = [repository / "README.md", *sorted((repository / "docs").glob("*.md"))]
    shown = {
        (page.parent / link).resolve() for page in pages for link in PICTURE.findall(page.read_text("utf-8"))
    }
    pictures = set((repository / "docs" / "images").iterdir())
    assert shown == pictures
    makers = "".join(path.read_text("utf-8") for path in (repository / "docs").glob("make_*.py"))
    commands = "".join(page.read_text("utf-8") for page in pages)
    made = [f'"{path.name}"' in makers or f"--plot docs/images/{path.name}" in commands for path in pictures]
    assert all(made), pictures


def test_pictures_are_small(repository: Path) -> None:
    sizes = {path.name: path.stat().st_size for path in (repository / "docs" / "images").glob("*.jpg")}
    assert sizes
    assert max(sizes.values()) < 200_000
    assert sum(sizes.values()) < 1_000_000
