"""Error of a command whose extra is not installed: one line, and exit status 2."""

import sys
from pathlib import Path

import numpy as np
import pytest
from datasets_recordings import Content, write_record3d
from tune_scene import ROOM

from taichi_mrf.cli import main as cli
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = None

FOR_ANOTHER_PURPOSE = {"dev", "docs", "octomap", "quadrants"}
"""No command needs these: two serve who works on the program, octomap is another name of bench, and quadrants
is a second compiler."""

TRIANGLE = "v 0 0 2\nv 1 0 2\nv 0 1 2\nf 1 2 3\n"
POSES = "0 0 0 0 0 0 0 1\n1 0.1 0 0 0 0 0 1\n"

COMMANDS = {
    "auto": ("optuna", ["tune", ROOM, "--auto", "2", "--no-viewer", "--out", "out"]),
    "bench": ("pyoctomap", ["eval", "fig10", "--data", "data", "--out", "out", "--voxel-sizes", "0.2"]),
    "cluster": ("distributed", ["map", ROOM, "--scheduler", "local", "--out", "out"]),
    "las": ("laspy", ["map", "clouds", "--out", "out"]),
    "mesh": ("embreex.rtcore_scene", ["map", "mesh:corner.obj?poses=poses.txt", "--out", "out"]),
    "ouster": ("ouster.sdk", ["map", "drive.osf", "--out", "out"]),
    "realsense": ("pyrealsense2", ["map", "realsense:", "--out", "out"]),
    "record3d": ("lzfse", ["map", "walk", "--out", "out"]),
    "rerun": ("rerun", ["export", "no-such-map.npz", "--to", "folder/map.rrd"]),
    "robot": ("yourdfpy", ["map", ROOM, "--robot", "arm.urdf", "--camera-link", "eye", "--out", "out"]),
    "ros": ("rosbags.highlevel", ["map", "drive.bag", "--out", "out"]),
    "store": ("zarr", ["map", ROOM, "--submap-size", "5", "--out", "out"]),
}
"""Extra -> a module of it, and a command that cannot do without."""

MESH = "trimesh", "mesh"
EXPORTS = {"glb": MESH, "stl": MESH, "obj": MESH, "mcap": ("foxglove", "robot"), "rrd": ("rerun", "rerun")}


@pytest.fixture(autouse=True)
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Input of the commands, in the folder that they run in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "corner.obj").write_text(TRIANGLE)
    (tmp_path / "poses.txt").write_text(POSES)
    (tmp_path / "drive.bag").touch()
    (tmp_path / "drive.osf").touch()
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "poses.txt").write_text(POSES)
    write_record3d(tmp_path / "walk", Content(1), pack=lambda data: b"bvx-" + data)
    for number in (0, 1):
        (tmp_path / "clouds" / f"scan-{number}.las").touch()
    (tmp_path / "data").mkdir()


def refused(arguments: list[str], extra: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command that has to say which extra it needs."""
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert f"pip install 'taichi-mrf[{extra}]'" in line
    assert printed.out == ""


@pytest.mark.parametrize("extra", COMMANDS)
def test_a_command_says_which_extra_it_needs(
    extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, arguments = COMMANDS[extra]
    monkeypatch.setitem(sys.modules, module, None)
    refused(arguments, extra, capsys)
    assert arguments[0] == "eval" or not Path("out").exists()  # eval leaves its parameters there


def test_an_export_says_which_extra_it_needs(
    backend: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = PinholeCamera(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
    m = MRFMap(voxel_size=0.2, noise=PolynomialNoise((0.01,)))
    m.add_keyframe(np.full(camera.shape, 2.0, np.float32), np.eye(4), camera)
    m.infer()
    m.save("map.npz")
    for suffix, (module, extra) in EXPORTS.items():
        with monkeypatch.context() as without:
            without.setitem(sys.modules, module, None)
            refused(["export", "map.npz", "--to", f"wall.{suffix}", "--arch", backend], extra, capsys)
        assert not Path(f"wall.{suffix}").exists()


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [("a.zarr", "zarr", "store"), ("a.glb", "trimesh", "mesh"), ("a.rrd", "rerun", "rerun")],
)
def test_an_export_asks_for_its_extra_before_it_reads_the_map(
    name: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    refused(["export", "no-such-map.npz", "--to", f"folder/{name}"], extra, capsys)
    assert not Path("folder").exists()


@pytest.mark.skipif(tomllib is None, reason="Python 3.10 reads no TOML")
def test_every_extra_has_its_command(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(project["optional-dependencies"]) == set(COMMANDS) | FOR_ANOTHER_PURPOSE
