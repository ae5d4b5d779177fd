"""The documentation site: it is built without a warning, its generated pages are complete, and every picture
comes from a script or a command."""

import dataclasses
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from new_interpreter import python

import taichi_mrf
import taichi_mrf.errors
from taichi_mrf.config.schema import Config
from taichi_mrf.config.values import is_in_files
from taichi_mrf.factor_graph.config import LaserConfig

REPOSITORY = Path(__file__).resolve().parents[2]


def names(section: Any, prefix: str = "") -> Iterator[str]:
    for field in filter(is_in_files, dataclasses.fields(section)):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from names(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site. A warning ends the build."""
    folder = tmp_path_factory.mktemp("site")
    built = build(REPOSITORY / "mkdocs.yml", folder)
    assert built.returncode == 0, built.stderr
    return folder


def build(configuration: Path, folder: Path) -> "subprocess.CompletedProcess[str]":
    flags = ("--strict", "--config-file", configuration, "--site-dir", folder)
    return python("-m", "mkdocs", "build", *flags, cwd=REPOSITORY)


def html(site: Path, page: str) -> str:
    return (site / page / "index.html").read_text(encoding="utf-8")


def test_the_site_is_built_without_a_warning(site: Path) -> None:
    front = html(site, ".")
    assert "taichi-mrf live" in front
    assert 'href="live/"' in front


def test_a_map_to_turn_is_one_small_file_that_the_front_page_links(site: Path) -> None:
    page = (site / "map.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert "default-src 'none'" in page  # nothing is loaded from a network
    assert 'strong><a href="map.html"' in html(site, ".")
    assert 'href="../map.html"' in html(site, "live")


def test_every_parameter_is_on_its_page(site: Path) -> None:
    page = html(site, "parameters")
    missing = [
        name for name in (*names(Config()), *names(LaserConfig())) if f"<code>{name}</code>" not in page
    ]
    assert not missing


def test_every_public_name_and_every_exception_is_on_the_api_page(site: Path) -> None:
    page = html(site, "api")
    exceptions = [
        name
        for name, each in vars(taichi_mrf.errors).items()
        if isinstance(each, type) and issubclass(each, taichi_mrf.TaichiMRFError)
    ]
    anchors = set(re.findall(r'id="taichi_mrf\.[\w.]*?(\w+)"', page)) | {"__version__"}
    assert not {*taichi_mrf.__all__, *exceptions} - anchors
    assert "add_keyframe" in anchors  # methods that the maps inherit
    assert {"RayHits", "MapSlice", "InferReport", "Dataset"} <= anchors  # what public functions return
    assert ":meth:" not in page


def test_the_plan_of_the_packages_is_made_from_the_table(site: Path) -> None:
    page = html(site, "architecture")
    packages = [path.parent.name for path in (REPOSITORY / "taichi_mrf").glob("*/__init__.py")]
    assert packages
    assert not [
        name for name in packages if f"<code>{name}/</code>" not in page or f">{name}</text>" not in page
    ]


LINK = re.compile(r"\]\(\s*<?([^)>\s]+)|(?:src|href)=\"([^\"]+)\"|^\[[^\]]+\]:\s*(\S+)", re.MULTILINE)
FENCED = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    plain = (
        re.sub(r"[`*]|\]\([^)]*\)|\[", "", each) for each in re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    )
    return {re.sub(r"[^\w\- ]", "", each.strip().lower()).replace(" ", "-") for each in plain}


@pytest.mark.parametrize(
    "page",
    [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), REPOSITORY / "data" / "README.md"],
    ids=lambda page: page.relative_to(REPOSITORY).as_posix(),
)
def test_every_relative_link_leads_somewhere_in_a_clone(page: Path) -> None:
    dead = []
    for match in LINK.finditer(FENCED.sub("", page.read_text(encoding="utf-8"))):
        link = next(filter(None, match.groups()))
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if re.match("[a-z]+:", link):
            continue
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            dead.append(link)
    assert not dead


def test_broken_links_and_anchors_end_the_build(tmp_path: Path) -> None:
    ours = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))
    broken = ["absent.md", "#nowhere", "/absolute", "other.md#missing"]
    (tmp_path / "docs").mkdir()
    text = "\n".join(f"[a link]({link})" for link in ["other.md", *broken])
    (tmp_path / "docs" / "index.md").write_text(f"# Start\n\n{text}\n")
    (tmp_path / "docs" / "other.md").write_text("# Other\n")
    configuration = tmp_path / "mkdocs.yml"
    configuration.write_text(yaml.safe_dump({"site_name": "x", "validation": ours["validation"]}))
    built = build(configuration, tmp_path / "site")
    assert built.returncode != 0
    warnings = [line for line in built.stderr.splitlines() if line.startswith("WARNING")]
    assert [link for link in broken if any(f"'{link}'" in line for line in warnings)] == broken


PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")


def test_every_picture_is_shown_and_comes_from_a_script_or_a_command(repository: Path) -> None:
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


def test_decisions_are_short_and_the_newest_come_first(repository: Path) -> None:
    text = (repository / "docs" / "decisions.md").read_text("utf-8")
    dates = re.findall(r"^## (\d{4}-\d\d-\d\d)$", text, re.MULTILINE)
    assert dates
    assert dates == sorted(set(dates), reverse=True)
    entries = re.findall(r"^### (.+)\n((?:(?!##).*\n?)*)", text, re.MULTILINE)
    assert len(entries) == text.count("\n### ")
    assert not [title for title, words in entries if len(words.split()) > 120]


FILE = re.compile(r"`((?:[\w.-]+/)*[\w-]+\.(?:py|cpp|toml))`")
PAGES = [
    *sorted((REPOSITORY / "docs").glob("*.md")),
    *REPOSITORY.glob("*.md"),
    REPOSITORY / "data" / "README.md",
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_the_files_that_a_page_names_exist(page: Path) -> None:
    """Names with a folder are relative to the repository or to the package."""
    named = set(FILE.findall(page.read_text(encoding="utf-8")))
    bare = {path.name for path in (REPOSITORY / "taichi_mrf").rglob("*.py")}
    missing = [
        name
        for name in named
        if not ((REPOSITORY / name).exists() or (REPOSITORY / "taichi_mrf" / name).exists() or name in bare)
    ]
    assert not missing
