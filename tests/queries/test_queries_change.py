"""The difference of two maps, against both maps' voxels one by one; and the command that prints it."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from console import carry_out
from hand_made import VOXEL
from queried_maps import hand_map, map_of, room, room_map

from taichi_mrf.errors import ConfigError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.system import runtime


def probability(log_odds: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-log_odds))


def test_every_voxel_of_both_maps_is_compared(backend: str) -> None:
    a, b = hand_map(backend, seed=1), hand_map(backend, seed=2)
    found = compare_maps(a, b)
    voxels = np.indices((48, 48, 48)).reshape(3, -1).T + np.array([-48, 16, -32])
    before, after = a.true_state(voxels), b.true_state(voxels)
    difference = probability(b.true_log_odds(voxels)) - probability(a.true_log_odds(voxels))
    counts = np.bincount(3 * before + after, minlength=9).reshape(3, 3)
    counts[0, 0] = 0
    np.testing.assert_array_equal(found.counts, counts)
    assert (counts.ravel()[1:] > 5).all()
    assert found.only_in_a == ((before != 0) & (after == 0)).sum()
    assert found.only_in_b == ((before == 0) & (after != 0)).sum()
    both, either = (before != 0) & (after != 0), (before != 0) | (after != 0)
    assert found.in_both == both.sum()
    assert found.changed == (both & (before != after)).sum()
    assert found.mean_difference == pytest.approx(np.abs(difference[both]).mean(), abs=1e-5)
    assert found.mean_difference_known == pytest.approx(np.abs(difference[either]).mean(), abs=1e-5)
    moved = before != after
    order = np.lexsort(np.floor(found.points / VOXEL).T[::-1])
    np.testing.assert_allclose(found.points[order], (voxels[moved] + 0.5) * VOXEL)
    np.testing.assert_array_equal(found.before[order], before[moved])
    np.testing.assert_array_equal(found.after[order], after[moved])
    np.testing.assert_allclose(found.difference[order], difference[moved], atol=1e-5)


@pytest.mark.usefixtures("backend")
def test_a_map_does_not_differ_from_itself() -> None:
    found = compare_maps(room_map("mrf"), room_map("mrf"))
    assert (found.changed, found.only_in_a, found.only_in_b, len(found.points)) == (0, 0, 0, 0)
    assert found.mean_difference == 0
    assert found.in_both > 10000


def test_other_voxel_sizes(backend: str) -> None:
    a = hand_map(backend)
    b = map_of(backend, (0, 0, 0), np.zeros((8, 8, 8)), voxel_size=0.1)
    with pytest.raises(ConfigError, match=r"cannot be compared: 0\.05 m and 0\.1 m"):
        compare_maps(a, b)


@pytest.fixture(scope="module")
def two_maps(backend: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("maps")
    room(MRFMap, range(3)).save(folder / "a.npz")
    room_map("mrf").save(folder / "b.npz")
    return folder / "a.npz", folder / "b.npz"


def diff(*arguments: object) -> int:
    return carry_out("diff", *arguments, "--arch", runtime.active() or "cpu")


def test_the_command_prints_a_table(two_maps: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert diff(*two_maps) == 0
    text = capsys.readouterr().out
    assert "occupied in A" in text
    assert "mean |difference| of probability" in text


def test_the_command_writes_json_and_points(
    two_maps: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert diff(*two_maps, "--json", "--out", tmp_path / "changes.ply") == 0
    report = json.loads(capsys.readouterr().out)
    found = compare_maps(*(MRFMap.load(path).decided for path in two_maps))
    assert report["only_in_b"] == found.only_in_b > 1000
    assert report["voxels"]["free"]["occupied"] == found.counts[1, 2]
    assert report["mean_difference"] == found.mean_difference > 0
    cloud = trimesh.load(tmp_path / "changes.ply")
    new = (found.after == 2) & (found.before != 2)
    gone = (found.before == 2) & (found.after != 2)
    assert report["changes"]["points"] == len(cloud.vertices) == new.sum() + gone.sum()
    colors = [tuple(color) for color in cloud.colors[:, :3].tolist()]
    assert colors.count((213, 94, 0)) == new.sum() > 0
    assert colors.count((0, 114, 178)) == gone.sum() > 0


def test_changes_are_written_as_ply_only(two_maps: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"changes\.obj: --out must end in \.ply"):
        diff(*two_maps, "--out", tmp_path / "changes.obj")
    assert not list(tmp_path.iterdir())
