"""``--json``: the same facts for programs, and nothing else on stdout."""

import json
import zipfile
from pathlib import Path
from typing import Any

from console import taichi_mrf

from taichi_mrf.system import compiler

SMALL = "synthetic:room?frames=3&width=80&height=60"


def said(*arguments: str | Path) -> Any:
    done = taichi_mrf(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_map_and_what_was_mapped(tmp_path: Path) -> None:
    report = said(
        "map", SMALL, "--out", tmp_path, "--voxel-size", "0.1", "--no-pictures", "--runtime.arch", "cpu"
    )
    assert report == json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    facts = said("info", SMALL, "--arch", "cpu")
    assert report["compiler"].startswith(f"{compiler.name()} 1.")
    assert (facts["frames"], facts["camera"]["width"], facts["format"]) == (3, 80, "synthetic:room")


def test_a_floor_map(tmp_path: Path) -> None:
    source = "synthetic:floor-plan?scans=20&beams=31"
    report = said("laser", source, "--out", tmp_path, "--iterations", "3", "--runtime.arch", "cpu")
    assert report == json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))


def test_the_backends() -> None:
    facts = said("info", "--arch", "cpu")
    assert facts["backend"] == "cpu"
    assert set(facts["backends"]) == {"cpu", "vulkan", "cuda"}
    assert facts["compiler"] == f"{compiler.name()} {facts['versions'][compiler.name()]}"


def test_info_reads_a_map_to_its_last_byte(tmp_path: Path) -> None:
    said("map", SMALL, "--out", tmp_path, "--voxel-size", "0.2", "--no-pictures", "--runtime.arch", "cpu")
    path = tmp_path / "map.npz"
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as file:
        members = {member.filename: member for member in file.infolist()}
    for name in ("belief.npy", "bricks.npy"):  # one that the facts need, and one that they do not
        damaged = bytearray(whole)
        begin = whole.index(name.encode()) + len(name)
        damaged[begin + members[name].compress_size // 2] ^= 0x10
        path.write_bytes(damaged)
        done = taichi_mrf("info", path)
        assert done.returncode == 2
        assert name.removesuffix(".npy") in done.stderr
