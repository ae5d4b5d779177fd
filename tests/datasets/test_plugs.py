"""Formats as plugs: another package's is read like the package's own, and no reader is imported before its
source is opened."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from console import FAST, mapped, report_of
from new_interpreter import python
from pages import code_of

from taichi_mrf.datasets.entries import FORMATS
from taichi_mrf.datasets.registry import GROUP, OWN, plugs

try:
    import tomllib
except ImportError:
    tomllib = None

OPENED = """
import json, sys
from pathlib import Path
import taichi_mrf as tm
from taichi_mrf.datasets.registry import format_name
from taichi_mrf.errors import DatasetError
found = []
for source in sys.argv[1:]:
    try:
        dataset = tm.open_dataset(source)
        frames = [[f.name, f.stamp, float(f.depth_m[0, 0]), *f.T_world_camera[:3, 3]] for f in dataset]
        found.append([format_name(source), frames, dataset.notes])
    except DatasetError as error:
        found.append(str(error))
print(json.dumps(found))
"""


def installed(folder: Path, package: str, plug: str, place: str, module: str = "") -> None:
    """Files that pip leaves of a package: a module, and its metadata with an entry point."""
    metadata = folder / f"{package}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{GROUP}]\n{plug} = {place}\n")
    if module:
        (folder / f"{package}.py").write_text(module)


def documented(repository: Path) -> str:
    """The module of the example."""
    section = (repository / "data" / "README.md").read_text("utf-8").partition("## A format of your own")[2]
    return code_of(section)[0]


def walk(folder: Path) -> Path:
    """Two frames in the example's format, in a folder that a built-in format would take too."""
    folder.mkdir()
    for number in (1, 2):
        np.save(folder / f"{number}.npy", np.full((48, 64), float(number), np.float32))
    (folder / "walk.csv").write_text("".join(f"{n}.5,{n},2,3,0,0,0,1,{n}.npy\n" for n in (1, 2)))
    (folder / "depth.txt").write_text("1.0 depth/1.png\n")
    return folder


def run(site: Path, repository: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    return python(*words, PYTHONPATH=os.pathsep.join([str(repository), str(site)]))


def test_the_documented_plug_is_read_and_broken_ones_are_named(tmp_path: Path, repository: Path) -> None:
    site, folder, empty = tmp_path / "site", walk(tmp_path / "walk"), tmp_path / "empty"
    empty.mkdir()
    (empty / "sheet.ods").touch()
    installed(site, "walk", "walk", "walk:FORMAT", documented(repository))
    installed(site, "gone", "gone", "no_such_module:FORMAT")
    installed(site, "no_format", "no_format", "no_format:FORMAT", "FORMAT = 3\n")
    odd = "FORMAT = Format('odd', 'odd things', lambda path: 1 / 0, open)\n"
    installed(site, "odd", "odd", "odd:FORMAT", f"from taichi_mrf.datasets.base import Format\n{odd}")
    done = run(site, repository, "-c", OPENED, str(folder), str(empty))
    assert done.returncode == 0, done.stderr
    opened, refused = json.loads(done.stdout.splitlines()[-1])
    assert opened[:2] == [
        "walk",
        [["1.npy", 1.5, 1.0, 1.0, 2.0, 3.0], ["2.npy", 2.5, 2.0, 2.0, 2.0, 3.0]],
    ]
    problems = [
        f"the plug 'gone' ({GROUP}) cannot be used: ModuleNotFoundError: No module named 'no_such_module'",
        f"the plug 'no_format' ({GROUP}) cannot be used: TypeError: it names 3, which is not a Format",
    ]
    raised = f"the plug 'odd' ({GROUP}) cannot be used: ZeroDivisionError: division by zero"
    assert {*problems, raised} <= set(opened[2])
    for text in ["RTAB-Map: a database", "odd: odd things", "walk: walk.csv", *problems]:
        assert text in refused


def test_a_plugs_recording_is_mapped(
    tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, folder = tmp_path / "site", walk(tmp_path / "walk")
    installed(site, "walk", "walk", "walk:FORMAT", documented(repository))
    monkeypatch.syspath_prepend(site)
    plugs.cache_clear()
    try:
        mapped(folder, "--out", tmp_path / "out", *FAST)
    finally:
        plugs.cache_clear()
    assert report_of(tmp_path / "out")["frames"]


@pytest.mark.skipif(tomllib is None, reason="Python 3.10 reads no TOML")
def test_this_packages_plugs_are_declared(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["entry-points"][GROUP] == OWN
    assert len({each.name for each in (*plugs()[0], *FORMATS)}) == len(OWN) + len(FORMATS)


def test_no_reader_is_imported_before_its_source_is_opened(repository: Path) -> None:
    program = (
        "import sys; import taichi_mrf as tm; import taichi_mrf.apps.batch; tm.init('cpu'); tm.MRFMap;"
        "tm.open_dataset('synthetic:room?frames=1').read(0);"
        "print(*(name for name in sys.modules if name.startswith('taichi_mrf.datasets.')))"
    )
    done = run(repository, repository, "-c", program)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "taichi_mrf.datasets.synthetic.room" in loaded
    rooms = ("formats", "laser", "lidar", "realsense", "ros.", "rtabmap", "stereo", "several", "rare")
    readers = tuple(f"taichi_mrf.datasets.{room}" for room in rooms)
    assert [name for name in loaded if name.startswith(readers)] == ["taichi_mrf.datasets.ros.names"]
