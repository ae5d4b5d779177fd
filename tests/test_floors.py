"""docs/floors.yaml holds: a package imports only what its entry allows, no two modules import each other in a
circle, every package says what it is for, and no file grows past 500 lines."""

import ast
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from new_interpreter import output

import taichi_mrf

PACKAGE = Path(taichi_mrf.__file__).parent
FLOORS = yaml.safe_load((PACKAGE.parent / "docs" / "floors.yaml").read_text(encoding="utf-8"))
APPS = PACKAGE.parent / "apps"
MOST_LOADED = 12_947
"""Lines of this package that MRFMap may load before a map is made."""

OPEN_TO_ALL = {"errors", ""}


@cache
def modules() -> dict[str, Path]:
    """Every module's dotted name below the package, with its file; those of apps/ lie beside the package."""
    found = {}
    for folder, paths in ((PACKAGE, PACKAGE.rglob("*.py")), (PACKAGE.parent, APPS.glob("*.py"))):
        for path in sorted(paths):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join(parts).removesuffix("__init__").removesuffix(".")] = path
    return found


@cache
def imports() -> dict[str, set[str]]:
    """The modules that each module imports, wherever in the file it does so."""
    graph = {name: _imported(path) & set(modules()) for name, path in modules().items()}
    graph[""] = set()  # the public names, which are loaded when they are asked for
    return graph


def _imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            inner = {name for name in submodules if _inside(name) in modules()}
            found |= inner or {node.module}
    return {_inside(name) for name in found if name.split(".")[0] == "taichi_mrf"}


def _inside(name: str) -> str:
    return name.removeprefix("taichi_mrf").removeprefix(".")


def room(module: str) -> str:
    return module.split(".")[0]


def test_the_table_has_no_cycle() -> None:
    seen: set[str] = set()
    for name, floor in FLOORS.items():
        assert set(floor["uses"]) <= seen, f"{name} uses what stands below it in docs/floors.yaml"
        seen.add(name)


def test_packages_import_only_what_the_table_allows() -> None:
    wrong = [
        f"{module} imports {name}"
        for module, names in imports().items()
        for name in names
        if room(module) not in {"", "__main__"}
        and room(name) not in {room(module), *OPEN_TO_ALL, *FLOORS[room(module)]["uses"]}
    ]
    assert not wrong


def test_rooms_of_a_package_import_only_the_rooms_that_the_table_allows() -> None:
    wrong = [
        f"{module} imports {name}"
        for package, floor in FLOORS.items()
        for module, names in imports().items()
        for name in names
        if room(module) == room(name) == package
        and (inner := inner_room(name, floor))
        and inner not in {inner_room(module, floor), *floor["rooms"].get(inner_room(module, floor), ())}
    ]
    assert not wrong


def inner_room(module: str, floor: dict[str, Any]) -> str | None:
    """The room of its package that a module stands in; None for one of the package's own modules."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in floor.get("rooms", {}) else None


def test_the_table_of_rooms_has_no_cycle() -> None:
    for package, floor in FLOORS.items():
        seen: set[str] = set()
        for name, uses in floor.get("rooms", {}).items():
            assert set(uses) <= seen, f"{package}.{name} uses what stands below it in docs/floors.yaml"
            seen.add(name)


def test_the_table_allows_nothing_that_nobody_uses() -> None:
    used: dict[str, set[str]] = {name: set() for name in FLOORS}
    for module, names in imports().items():
        if room(module) in used:
            used[room(module)] |= {room(name) for name in names} - {room(module), *OPEN_TO_ALL}
    assert used == {name: set(floor["uses"]) for name, floor in FLOORS.items()}


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {name: set(names) - {name} for name, names in imports().items()}
    while leaves := {name for name, names in graph.items() if not names & set(graph)}:
        graph = {name: names for name, names in graph.items() if name not in leaves}
    assert not {name for name in graph if any(name in graph[other] for other in graph)}


def test_every_package_says_what_it_is_for() -> None:
    packages = [path for path in modules().values() if path.name == "__init__.py"]
    assert not [path for path in packages if not ast.get_docstring(ast.parse(path.read_text("utf-8")))]


def test_a_map_loads_no_exporter_simulator_dataset_or_page() -> None:
    program = "import sys, taichi_mrf; taichi_mrf.MRFMap; print(*filter(None, sys.modules), sep=chr(10))"
    loaded = {_inside(name) for name in output(program).splitlines() if name.startswith("taichi_mrf")}
    above = {"export", "datasets", "viewer", "session", "mapping", "factor_graph", "cli"}
    assert not {name for name in loaded if room(name) in above}
    lines = sum(len(modules()[name].read_text("utf-8").splitlines()) for name in loaded)
    assert lines <= MOST_LOADED, f"raise MOST_LOADED to {lines} if the new lines are worth it"


def test_no_file_grows_past_500_lines() -> None:
    lengths = {name: len(path.read_text("utf-8").splitlines()) for name, path in modules().items()}
    assert not {name: length for name, length in lengths.items() if length > 500}


def test_no_package_grows_over_its_lines(capsys: pytest.CaptureFixture[str]) -> None:
    today = dict.fromkeys(FLOORS, 0)
    for name, path in modules().items():
        if room(name) in today:
            today[room(name)] += len(path.read_text("utf-8").splitlines())
    allowed = {name: floor["lines"] for name, floor in FLOORS.items()}
    with capsys.disabled():
        print(f"\nlines: {sum(today.values()):,} of {sum(allowed.values()):,} allowed")
    over = {name: f"{today[name]:,} of {allowed[name]:,}" for name in FLOORS if today[name] > allowed[name]}
    assert not over, f"packages over the lines that docs/floors.yaml allows: {over}; all: {today}"
