"""What the documentation site is made of beside docs/: the README files, the changelog, all parameters.

MkDocs calls these hooks (mkdocs.yml). Nothing is written twice: the page of parameters is made from the
dataclasses, the front page from README.md.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import field_help
from taichi_mrf.factor_graph.config import LaserConfig

ROOT = Path(__file__).resolve().parents[1]

BROUGHT_IN = {"index.md": "README.md", "data.md": "data/README.md", "changelog.md": "CHANGELOG.md"}
"""Page -> the file that it is made from."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that do not lie in docs/."""
    for page, source in BROUGHT_IN.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "parameters.md", content=parameters_page()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links among the repository's files become links among pages; other files are named, not linked."""
    for page, source in BROUGHT_IN.items():
        markdown = re.sub(rf"\]\((?:\.\./)?{re.escape(source)}(#[^)]*)?\)", rf"]({page}\1)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)?docs/\)", "](architecture.md)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)?docs/([^)]+)\)", r"](\1)", markdown)
    elsewhere = r"(?:LICENSE|(?:examples|configs|taichi_mrf)/)[^)]*"
    return re.sub(rf"\[([^\]]+)\]\((?:\.\./)?{elsewhere}\)", r"\1", markdown)


def parameters_page() -> str:
    """Every parameter with its default and its help, from the dataclasses."""
    sections = [
        "# Parameters\n",
        "One YAML file holds any of these; `taichi-mrf map --help` lists them as flags, and a file needs to "
        "hold only what it changes.\n",
        *_section(Config(), "", "Maps"),
        "`taichi-mrf laser` has parameters of its own:\n",
        *_section(LaserConfig(), "", "Laser scans"),
    ]
    return "\n".join(sections)


def _section(section: Any, prefix: str, title: str) -> list[str]:
    """A heading, a table of the plain fields, then the nested sections."""
    texts = field_help(type(section))
    rows: list[str] = []
    nested: list[str] = []
    for field in dataclasses.fields(section):
        value, name = getattr(section, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            nested += _section(value, f"{name}.", name)
            continue
        shown = "" if value is None else f"`{_plain(value)}`"
        meaning = texts[field.name].replace("|", "\\|")
        rows.append(f"| `{name}` | {shown} | {meaning} |")
    table = ["| parameter | default | meaning |", "| --- | --- | --- |", *rows, ""]
    return [f"## {title}\n", "\n".join(table), *nested]


def _plain(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
