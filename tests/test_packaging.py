"""The wheel holds what the program needs, and runs where nothing of the source tree can be found."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import taichi_mrf
from taichi_mrf.cli.parser import parse

SOURCES = (
    "taichi_mrf",
    "apps",
    "configs",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
)


@pytest.fixture(scope="module")
def wheel(request: pytest.FixtureRequest, repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing is left in the source tree."""
    if request.config.getoption("--quick"):
        pytest.skip("left out by --quick: it starts processes")
    pytest.importorskip("setuptools", minversion="77")
    folder = tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        source, copy = repository / name, folder / "source" / name
        copy.parent.mkdir(exist_ok=True)
        shutil.copytree(source, copy) if source.is_dir() else shutil.copy(source, copy)
    command = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", *command, str(folder / "source")], check=True)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def clean_python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter with the wheel and the packages that it depends on, and without the source tree."""
    folder = tmp_path_factory.mktemp("clean") / "venv"
    venv.create(folder, with_pip=False)
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    command = ["pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([sys.executable, "-m", *command], check=True)
    packages = next(folder.rglob("site-packages"))
    # Of this interpreter the dependencies alone: its .pth files, which lead to the source tree, do not count.
    (packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    return python


def test_the_wheel_holds_all_that_the_program_needs_and_no_more(wheel: Path, repository: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
        info = {
            name.partition(".dist-info/")[2]: name for name in archive.namelist() if ".dist-info/" in name
        }
        metadata = archive.read(info["METADATA"]).decode()
    package = (path for path in (repository / "taichi_mrf").rglob("*") if path.is_file())
    expected = {path.relative_to(repository).as_posix() for path in package if path.suffix != ".pyc"}
    for folder, kind in (("apps", "*.py"), ("configs", "*.yaml")):
        expected |= {f"taichi_mrf/{folder}/{path.name}" for path in (repository / folder).glob(kind)}
    assert found == expected
    assert "taichi_mrf/py.typed" in found
    assert "licenses/LICENSE" in info
    assert "License-Expression: MIT" in metadata
    assert f"Version: {taichi_mrf.__version__}" in metadata


def test_an_installed_wheel_maps_with_a_shipped_configuration(clean_python: Path, tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        program = clean_python.parent / arguments[0]
        done = subprocess.run(
            [str(program), *arguments[1:]],
            capture_output=True, text=True, check=False, cwd=tmp_path, env=environment,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = run(clean_python.name, "-c", "import taichi_mrf; print(taichi_mrf.__file__)")
    assert Path(where.strip()).is_relative_to(clean_python.parent.parent)
    names = f"import taichi_mrf\nfor name in {taichi_mrf.__all__}: getattr(taichi_mrf, name)"
    run(clean_python.name, "-W", "error", "-c", names)
    assert run("taichi-mrf", "--version") == f"taichi-mrf {taichi_mrf.__version__}\n"
    arguments = ("--config", "kinect1", "--voxel-size", "0.2", "--out", "run")
    run("taichi-mrf", "map", "synthetic:room?frames=2", *arguments)
    assert (tmp_path / "run" / "report.json").is_file()
    said = run(clean_python.name, "-m", "taichi_mrf.apps.batch", "--help")
    assert said == run("taichi-mrf", "map", "--help")


def dependencies(repository: Path) -> dict[str, list[str]]:
    """The requirements of pyproject.toml without their conditions; those of every installation as ``""``."""
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    stated = {"": project["dependencies"], **project["optional-dependencies"]}
    return {extra: [each.partition(";")[0].strip() for each in needed] for extra, needed in stated.items()}


CONDA = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}
"""Packages whose name at conda-forge is another."""


def test_the_conda_recipe_asks_for_what_the_project_asks_for(repository: Path) -> None:
    recipe = yaml.safe_load((repository / "release" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == taichi_mrf.__version__
    expected = []
    for requirement in dependencies(repository)[""]:
        name, bounds = re.fullmatch(r"([\w-]+)(.*)", requirement).groups()
        if name != "quadrants":  # for machines where Taichi has no wheel
            expected.append(f"{CONDA.get(name, name)} {bounds}")
    python, *others = recipe["requirements"]["run"]
    assert others == expected
    assert python.startswith("python ")
    project = (repository / "pyproject.toml").read_text(encoding="utf-8")
    assert f'requires-python = ">={recipe["context"]["python_min"]},' in project
    assert recipe["build"]["python"]["entry_points"] == ["taichi-mrf = taichi_mrf.cli.start:start"]
    assert 'taichi-mrf = "taichi_mrf.cli.start:start"' in project


def test_the_licence_of_each_dependency_is_listed(repository: Path) -> None:
    text = (repository / "docs" / "licences.md").read_text(encoding="utf-8")
    base, extras = (set(re.findall(r"[\w-]+(?=[,.](?: |\n))", part)) for part in text.split("\n## ")[1:])
    for extra, needed in dependencies(repository).items():
        names = {re.match(r"[\w-]+", each)[0] for each in needed}
        if extra == "":
            assert names - {"quadrants"} <= base
        elif extra not in ("dev", "docs"):
            assert names <= extras


def test_the_citation_names_this_version(repository: Path) -> None:
    facts = yaml.safe_load((repository / "CITATION.cff").read_text(encoding="utf-8"))
    assert facts["version"] == taichi_mrf.__version__
    assert facts["license"] == "MIT"


def test_workflows_and_containers_name_what_there_is(repository: Path) -> None:
    """The folders of tests, the commands and the extras in files that no other test runs."""
    named = []
    for path in (repository / ".github" / "workflows").iterdir():
        for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values():
            words = " ".join(step.get("run", "") for step in job["steps"]).split()
            named += [word for word in words if word.startswith(("tests/", ".ci/", "release/"))]
    assert {".ci/run", "release/try_wheel.py"} < set(named)
    assert not [word for word in named if not (repository / word).exists()]
    service = yaml.safe_load((repository / "compose.yaml").read_text(encoding="utf-8"))["services"]["live"]
    recipe = (repository / "Dockerfile").read_text(encoding="utf-8")
    assert f"CMD {json.dumps(service['command'])}" in recipe
    parse(service["command"])
    (extras,) = re.findall(r'"/source\[([\w,]+)\]"', recipe)
    project = (repository / "pyproject.toml").read_text(encoding="utf-8")
    for extra in extras.split(","):
        assert re.search(rf"^{extra} = \[", project, re.MULTILINE), extra
