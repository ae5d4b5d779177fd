"""The house plan of docs/architecture.md: a file imports only from its own floor or from floors below."""

import ast
from pathlib import Path

import pytest

import taichi_mrf

PACKAGE = Path(taichi_mrf.__file__).parent

FLOORS = [
    {
        "errors",
        "poses",
        "config",
        "config_poses",
        "config_text",
        "config_values",
        "camera",
        "frame",
        "libraries",
        "npz_file",
        "devices",
        "runtime",
        "voxels",
        "",
    },
    {"sensor", "keyframes"},
    {"inference", "queries", "datasets", "export", "viewer", "factor_graph", "alignment"},
    {"maps"},
    {"pipeline"},
    {"evaluation", "calibration", "cluster", "submaps"},
    {"live", "tune"},
    {"commands", "cli", "__main__"},
]
"""From the ground up; the empty name is the package itself, which loads its public names when asked."""

FILES = sorted(PACKAGE.rglob("*.py"))


def floor_of(module: str) -> int:
    room = module.removeprefix("taichi_mrf").removeprefix(".").split(".")[0]
    return next(number for number, rooms in enumerate(FLOORS) if room in rooms)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_nothing_is_imported_upwards(path: Path) -> None:
    module = ".".join(["taichi_mrf", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(
        ".__init__"
    )
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        imported = [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        imported += [each.name for each in node.names] if isinstance(node, ast.Import) else []
        for name in imported:
            if name.startswith("taichi_mrf"):
                assert floor_of(name) <= floor_of(module), f"{module} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_file_outgrows_its_room(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400
