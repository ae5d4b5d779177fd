"""Measurements of frozen keyframes stay a part of surface and reading with ``keep_surface``."""

from pathlib import Path

import colored_scene as scene
import numpy as np
import pytest
from scipy.spatial import KDTree

from taichi_mrf.errors import ConfigError, MapFileError
from taichi_mrf.export.formats import export_map, export_note
from taichi_mrf.export.fused_surface import FusedSurface
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.inference.brick_sums import LARGEST, BrickSums
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.storage import contents_of, read_contents, write_contents

pytestmark = pytest.mark.usefixtures("one_backend")


def build(numbers: list[int], keep: bool = True) -> MRFMap:
    m = MRFMap(scene.VOXEL, scene.NOISE, keep_surface=keep)
    for number in numbers:
        scene.add(m, number)
    m.infer()
    return m


def assert_same(ours: FusedSurface, theirs: FusedSurface) -> None:
    """But for rounding: sums are rounded to 1/1024 of the weight of one pixel."""
    distance_m, nearest = KDTree(theirs.vertices_m).query(ours.vertices_m)
    assert (distance_m < 0.01 * scene.VOXEL).mean() > 0.99
    assert abs(len(ours.triangles) - len(theirs.triangles)) < 0.005 * len(theirs.triangles)
    near = distance_m < 0.01 * scene.VOXEL
    # How far distances differ is the root of a small difference of rounded sums.
    np.testing.assert_allclose(
        ours.std_m[near], theirs.std_m[nearest[near]], rtol=0.1, atol=0.02 * scene.VOXEL
    )


def test_a_frozen_keyframe_keeps_its_part() -> None:
    m = build([0, 1, 2, 3])
    before, colors = m.surface(), m.colors(scene.probes())
    state = m.decided.state(scene.probes())
    for id in (1, 2):
        m.freeze_keyframe(id)
    assert m.has_surface
    assert "of 4 keyframes" in str(export_note(m, Path("mesh.glb")))
    assert_same(m.surface(), before)
    np.testing.assert_array_equal(m.decided.state(scene.probes()), state)
    np.testing.assert_array_equal(m.colors(scene.probes()), colors)
    for id in (0, 3):
        m.freeze_keyframe(id)
    assert_same(m.surface(), before)
    np.testing.assert_array_equal(m.decided.state(scene.probes()), state)
    # What is kept is part of the map's size: 12 bytes a voxel for distances, 4 for votes.
    assert m._parts.kept.share.nbytes < 14 * 512 * (
        len(m._parts.kept.share.distances.bricks) + m.statistics().bricks
    )


def test_it_does_not_depend_on_the_order_of_freezing() -> None:
    first, second = build([0, 1, 2, 3]), build([3, 1, 0, 2])
    for m, order in ((first, range(4)), (second, (2, 0, 3, 1))):
        for id in order:
            m.freeze_keyframe(id)
    for name in ("distances", "votes"):
        ours, theirs = getattr(first._parts.kept.share, name), getattr(second._parts.kept.share, name)
        np.testing.assert_array_equal(ours.bricks, theirs.bricks)
        np.testing.assert_array_equal(ours.sums, theirs.sums)


def test_nothing_is_kept_unless_it_is_asked_for(tmp_path: Path) -> None:
    m = build([0, 1], keep=False)
    m.freeze_keyframe(0)
    assert m._parts.kept.share.nbytes == 0
    assert not m.has_surface
    with pytest.raises(ConfigError, match="--keep-surface"):
        export_map(m, tmp_path / "mesh.ply", ExportOptions(mesh=True, surface="rays"))
    m.freeze_keyframe(1)
    with pytest.raises(ConfigError, match="no keyframes"):
        m.surface()
    m.save(tmp_path / "map.npz")
    assert not [name for name in np.load(tmp_path / "map.npz").files if name.startswith("frozen_distance")]


def test_it_is_saved_with_the_map(tmp_path: Path) -> None:
    m = build([0, 1, 2])
    for id in (0, 2):
        m.freeze_keyframe(id)
    m.infer()
    m.save(tmp_path / "map.npz")
    again = MRFMap.load(tmp_path / "map.npz")
    assert again.has_surface
    np.testing.assert_array_equal(again.surface().vertices_m, m.surface().vertices_m)
    np.testing.assert_array_equal(
        again.decided.occupancy(scene.probes()), m.decided.occupancy(scene.probes())
    )
    share = m._parts.kept.share
    m._parts.kept.share = RayShare(BrickSums(share.distances.bricks, -share.distances.sums), share.votes)
    header = read_contents(tmp_path / "map.npz").header
    write_contents(tmp_path / "bad.npz", contents_of(header, m._parts, []))
    with pytest.raises(MapFileError, match="frozen_distance_bricks or _sums are not in order"):
        MRFMap.load(tmp_path / "bad.npz")


def test_sums_add_up_brick_by_brick_and_stop_at_their_largest() -> None:
    rng = np.random.default_rng(0)
    expected: dict[tuple[int, ...], np.ndarray] = {}
    total = BrickSums.nothing(2)
    for _ in range(4):
        bricks = np.unique(rng.integers(-2, 2, (9, 3)), axis=0).astype(np.int32)
        sums = rng.integers(-50, 50, (len(bricks), 512, 2)).astype(np.int32)
        sums[0] = 0
        total = total.plus(BrickSums.of(bricks, sums))
        for brick, each in zip(bricks[1:].tolist(), sums[1:], strict=True):
            expected[tuple(brick)] = expected.get(tuple(brick), 0) + each
    assert {tuple(brick) for brick in total.bricks.tolist()} == set(expected)
    for brick, sums in zip(total.bricks.tolist(), total.sums, strict=True):
        np.testing.assert_array_equal(sums, expected[tuple(brick)])
    full = BrickSums(total.bricks, np.full_like(total.sums, LARGEST - 1))
    full.sums[..., 1] //= 2
    more = full.plus(full).sums
    assert (more[..., 0] == LARGEST).all()
    assert (np.abs(more[..., 1] - LARGEST // 2) <= 1).all()  # their ratio stays
    inside = total.inside(np.array([[-1, 0, 0]], np.int32))
    np.testing.assert_array_equal(inside, (total.bricks // 8 == [-1, 0, 0]).all(axis=1))
