"""Adds to the documentation site what is not written in docs/.

MkDocs calls these hooks (mkdocs.yml). Nothing is written twice: the front page is README.md, the page of
parameters is made from the dataclasses, the API page from docstrings (api_page.py), and the plan of the
packages from floors.yaml (floor_plan.py), the way of a depth image from its table (depth_way.py), a map to
turn from the built-in room (map_page.py).
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

from api_page import api_page
from depth_way import depth_way
from floor_plan import floor_plan
from map_page import map_page
from mkdocs.structure.files import File, Files

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import field_help
from taichi_mrf.config.values import is_in_files
from taichi_mrf.factor_graph.config import LaserConfig

ROOT = Path(__file__).resolve().parents[1]

BROUGHT_IN = {
    "index.md": "README.md",
    "data.md": "data/README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
"""Page -> the file that it is made from."""

FLOORS, WAY = "<!-- floors -->", "<!-- way -->"
"""The lines of docs/architecture.md that its two figures replace."""

TURN = "**[Turn this map in your browser](map.html)**, before you install anything."
"""Stands on the front page below its first picture."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that do not lie in docs/."""
    for page, source in BROUGHT_IN.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "parameters.md", content=parameters_page()))
    files.append(File.generated(config, "api.md", content=api_page()))
    files.append(File.generated(config, "map.html", content=map_page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put in the plan of the packages and the link to the map. Links among the repository become links
    among pages, and links to files that are no pages become their names.
    """
    if FLOORS in markdown:
        markdown = markdown.replace(FLOORS, floor_plan()).replace(WAY, f"<div>{depth_way(markdown)}</div>")
    if page.file.src_uri == "index.md":
        markdown = re.sub(r"^!\[.*$", rf"\g<0>\n\n{TURN}", markdown, count=1, flags=re.MULTILINE)
    for name, source in BROUGHT_IN.items():
        markdown = re.sub(rf"\]\((?:\.\./)?{re.escape(source)}(#[^)]*)?\)", rf"]({name}\1)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)?configs/default\.yaml\)", "](parameters.md)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)?docs/\)", "](architecture.md)", markdown)
    markdown = re.sub(r"\]\((?:\.\./)?docs/([^)]+)\)", r"](\1)", markdown)
    elsewhere = r"(?:LICENSE|(?:apps|examples|configs|taichi_mrf|tests|Makefile)/?)[^)]*"
    return re.sub(rf"\[([^\]]+)\]\((?:\.\./)?{elsewhere}\)", r"\1", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Docstrings name code as reStructuredText does, ``:meth:`infer```; on the page only the code stays."""
    return re.sub(r":(?:attr|class|func|meth|mod):(?=<code>)", "", html)


def parameters_page() -> str:
    """Every parameter with its default and its help, from the dataclasses."""
    sections = [
        "# Parameters\n",
        "A YAML file sets any of these, and needs to hold only what it changes (`--config FILE`). What "
        "changes from run to run is a flag as well: `taichi-mrf map --help-all` lists them.\n",
        *_section(Config(), "", "Maps from depth images"),
        "`taichi-mrf laser` has its own parameters:\n",
        *_section(LaserConfig(), "", "Maps from laser scans"),
    ]
    return "\n".join(sections)


def _section(section: Any, prefix: str, title: str) -> list[str]:
    """A heading, a table of the plain fields, then the nested sections."""
    texts = field_help(type(section))
    rows: list[str] = []
    nested: list[str] = []
    for field in filter(is_in_files, dataclasses.fields(section)):
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
