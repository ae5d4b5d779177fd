"""A mapping method is a plug: one entry says all that the rest of the program needs to know of it."""

import json
import os
import re
from pathlib import Path

import pytest
from new_interpreter import output, python

from taichi_mrf.config.method import Method
from taichi_mrf.config.plugs import PLUGS
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.system.compiler import COMPILERS


@pytest.mark.parametrize("method", METHODS.values(), ids=lambda method: method.name)
def test_an_entry_fits_its_class_and_its_section(method: Method) -> None:
    assert method.load_class().METHOD is method
    assert {slider.name for slider in method.sliders} <= set(vars(getattr(Config(), method.section)))


def test_nothing_outside_the_methods_asks_for_their_classes(repository: Path) -> None:
    names = "|".join(method.class_name for method in METHODS.values())
    asks = re.compile(
        rf"isinstance\([^)]*\b({names}|RecursiveMap|BrickMap)\b|['\"]({'|'.join(METHODS)})['\"]"
    )
    # A picture of a ray is labelled "visibility", a mean of messages is one of log-odds, and so on.
    words = {
        "config/sections.py",
        "config/gone.py",
        "inference/sweep.py",
        "viewer/scene/ray_plot.py",
        "voxels/layers.py",
        "evaluation/experiments/peers/systems.py",
    }
    words |= {"factor_graph/config.py"}
    package = repository / "taichi_mrf"
    found = [
        f"{name}: {line.strip()}"
        for path in sorted(package.rglob("*.py"))
        if not (name := path.relative_to(package).as_posix()).startswith("methods/") and name not in words
        for line in path.read_text(encoding="utf-8").splitlines()
        if asks.search(line)
    ]
    assert not found


def test_plugs_load_without_taichi() -> None:
    imports = "; ".join(f"import {plug}" for plug in PLUGS)
    output(f"{imports}; import sys; assert not {set(COMPILERS)} & set(sys.modules)")


def test_another_method_needs_its_folder_and_one_line(tmp_path: Path, repository: Path) -> None:
    support = repository / "tests" / "support"
    path = os.pathsep.join([str(support), str(repository), os.environ.get("PYTHONPATH", "")])
    done = python(support / "toy_method" / "program.py", tmp_path, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {
        "yaml": "toy",
        "method": "toy",
        "hit": 0.8,
        "refused": "a map of the method toy cannot freeze keyframes",
        "stale": True,
        "settled": True,
        "loaded": "ToyMap",
        "loaded_hit": 0.8,
        "keyframes": 1,
    }
