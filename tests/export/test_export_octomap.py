"""OctoMap's files: written by us and read by OctoMap itself, and the other way round."""

import json
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from console import carry_out
from hand_made import PRIOR, VOXEL
from queried_maps import HandMap, hand_map, map_of, room_map

from taichi_mrf.errors import CapacityError, ConfigError, MapFileError
from taichi_mrf.export.octomap import brick_codes, bricks_of_codes, octree_of, write_bt, write_ot, z_order
from taichi_mrf.export.octomap_reader import OctomapLeaves, read_octomap
from taichi_mrf.methods.log_odds.map import LogOddsMap
from taichi_mrf.queries.cells import standing_cells
from taichi_mrf.queries.known_bricks import BrickReader, known_bricks
from taichi_mrf.voxels.layout import BRICK


@pytest.fixture(scope="module")
def octomap() -> ModuleType:
    return pytest.importorskip("pyoctomap", reason="OctoMap itself is not here: pip install pyoctomap")


@pytest.fixture(scope="module")
def hand(one_backend: str) -> HandMap:
    return hand_map(one_backend)


def read_tree(octomap: ModuleType, path: Path, voxel_size: float = VOXEL) -> object:
    tree = octomap.OcTree(voxel_size)
    if path.suffix == ".bt":
        assert tree.readBinary(str(path))
        return tree
    return tree.read(str(path))


def leaves_of(tree: object) -> dict[tuple[tuple[int, ...], int], float]:
    """OctoMap's own list of its leaves: lower voxel and side in voxels -> log-odds."""
    size = tree.getResolution()  # type: ignore[attr-defined]
    found = {}
    for leaf in tree.begin_leafs():  # type: ignore[attr-defined]
        side = round(leaf.getSize() / size)
        lower = np.rint(np.array(leaf.getCoordinate()) / size - 0.5 * side).astype(int)
        found[tuple(lower.tolist()), side] = leaf.current_node.getLogOdds()
    return found


def voxels_of(leaves: dict[tuple[tuple[int, ...], int], float]) -> dict[tuple[int, ...], float]:
    """Each voxel of each leaf."""
    return {
        tuple((np.array(lower) + step).tolist()): value
        for (lower, side), value in leaves.items()
        for step in np.ndindex(side, side, side)
    }


def known_voxels(m: HandMap) -> dict[tuple[int, ...], float]:
    """How probable it is that each voxel that the map knows is occupied, by its own point queries."""
    bricks = known_bricks(m)
    inside = np.indices((BRICK,) * 3).reshape(3, -1).T
    voxels = (bricks[:, None] * BRICK + inside).reshape(-1, 3)
    points = (voxels + 0.5) * m.voxel_size
    known = m.state(points) != 0
    return dict(zip(map(tuple, voxels[known].tolist()), m.occupancy(points)[known].tolist(), strict=True))


def probabilities(log_odds: Iterable[float]) -> np.ndarray:
    return 1 / (1 + np.exp(-np.array(list(log_odds))))


@pytest.mark.parametrize("which", ["hand", "mrf", "log_odds"])
def test_octomap_reads_the_log_odds_of_all_known_voxels_and_no_others(
    octomap: ModuleType, hand: HandMap, which: str, tmp_path: Path
) -> None:
    m = hand if which == "hand" else room_map(which).decided
    write_ot(tmp_path / "map.ot", m)
    tree = read_tree(octomap, tmp_path / "map.ot")
    assert tree.getResolution() == pytest.approx(m.voxel_size)  # type: ignore[attr-defined]
    found, wanted = voxels_of(leaves_of(tree)), known_voxels(m)
    assert found.keys() == wanted.keys()
    assert len(found) > 10000
    p = probabilities(found[v] for v in wanted)
    np.testing.assert_allclose(p, list(wanted.values()), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("which", ["hand", "mrf", "log_odds"])
def test_octomap_reads_what_is_free_and_what_is_occupied(
    octomap: ModuleType, hand: HandMap, which: str, tmp_path: Path
) -> None:
    m = hand if which == "hand" else room_map(which).decided
    write_bt(tmp_path / "map.bt", m)
    tree = read_tree(octomap, tmp_path / "map.bt")
    found, wanted = voxels_of(leaves_of(tree)), known_voxels(m)
    assert found.keys() == wanted.keys()
    for voxel, p in wanted.items():
        assert (found[voxel] > 0) == (p > 0.5)


def test_octomap_would_write_the_same_bytes(octomap: ModuleType, hand: HandMap, tmp_path: Path) -> None:
    """Nothing is left to prune, the nodes stand in the same order, and inner nodes hold the same."""
    for name, write, again in (("map.bt", write_bt, "writeBinary"), ("map.ot", write_ot, "write")):
        write(tmp_path / name, hand)
        tree = read_tree(octomap, tmp_path / name)
        assert tree.size() == tree.calcNumNodes()  # type: ignore[attr-defined]
        assert getattr(tree, again)(str(tmp_path / f"again_{name}"))
        data = [(tmp_path / n).read_bytes().partition(b"\ndata\n")[2] for n in (name, f"again_{name}")]
        assert data[0] == data[1]
        assert len(data[0]) > 1000


def test_eight_equal_bricks_are_one_leaf(octomap: ModuleType, backend: str, tmp_path: Path) -> None:
    log_odds = np.full((32, 16, 16), -3.0)
    log_odds[20, 3, 5] = 2.0
    m = map_of(backend, (-16, 0, -16), log_odds)
    write_ot(tmp_path / "map.ot", m)
    leaves = leaves_of(read_tree(octomap, tmp_path / "map.ot"))
    assert leaves.pop(((-16, 0, -16), 16)) == pytest.approx(-3.0)
    assert leaves[(4, 3, -11), 1] == pytest.approx(2.0)
    assert {side for _, side in leaves} == {1, 2, 4, 8}


@pytest.mark.parametrize("name", ["map.ot", "map.bt"])
def test_a_cell_that_is_likely_as_a_whole_is_one_occupied_node(
    octomap: ModuleType, hand: HandMap, backend: str, name: str, tmp_path: Path
) -> None:
    """An inner node of the tree, without children; all other voxels are as without cells."""
    log_odds = np.full((16, 16, 16), -4.0)
    log_odds[2:4, :8, :8] = -0.8  # two layers
    log_odds[:8, 8:, 8:] = -1.99  # eight
    log_odds[9, 9, 9] = 2.0
    write = write_ot if name.endswith("ot") else write_bt
    for m in (map_of(backend, (0, 0, 0), log_odds), hand):
        write(tmp_path / name, m, cells=True)
        tree = read_tree(octomap, tmp_path / name)
        leaves = leaves_of(tree)
        assert as_dict(read_octomap(tmp_path / name)) == pytest.approx(leaves, abs=1e-3)
        standing = {
            (tuple(cell), cells.side): p
            for cells in standing_cells(m)
            for cell, p in zip(cells.lowest.tolist(), cells.probability.tolist(), strict=True)
        }
        # Eight equal nodes are one larger node, so that voxels are compared, not nodes.
        found, inside = voxels_of(leaves), voxels_of(standing)
        others = {voxel: p for voxel, p in known_voxels(m).items() if voxel not in inside}
        assert found.keys() == inside.keys() | others.keys()
        assert all((found[voxel] > 0) == (p > 0.5) for voxel, p in (inside | others).items())
        if name.endswith("ot"):
            assert probabilities(found[v] for v in inside) == pytest.approx(list(inside.values()), abs=1e-4)
        if m is not hand:
            assert {side for _, side in standing} == {2, 8}
            node = tree.search([0.12, 0.03, 0.03], 15)  # type: ignore[attr-defined]
            assert tree.isNodeOccupied(node)  # type: ignore[attr-defined]
            assert not tree.nodeHasChildren(node)  # type: ignore[attr-defined]


def test_an_empty_map_is_an_empty_tree(octomap: ModuleType, backend: str, tmp_path: Path) -> None:
    m = map_of(backend, (0, 0, 0), np.full((8, 8, 8), PRIOR))
    for name, write in (("map.bt", write_bt), ("map.ot", write_ot)):
        write(tmp_path / name, m)
        assert read_tree(octomap, tmp_path / name).size() == 0  # type: ignore[attr-defined]
        assert len(read_octomap(tmp_path / name).code) == 0


def test_the_reader_finds_the_leaves_that_octomap_finds(
    octomap: ModuleType, hand: HandMap, tmp_path: Path
) -> None:
    for name, write in (("map.bt", write_bt), ("map.ot", write_ot)):
        write(tmp_path / name, hand)
        assert as_dict(read_octomap(tmp_path / name)) == pytest.approx(
            leaves_of(read_tree(octomap, tmp_path / name)), abs=1e-3
        )


def test_a_tree_of_octomaps_own_making(octomap: ModuleType, tmp_path: Path) -> None:
    tree = octomap.OcTree(0.2)
    random = np.random.default_rng(0)
    for point in random.uniform(-3, 3, (300, 3)):
        tree.updateNode(point.tolist(), bool(random.random() < 0.5))
    for x, y, z in np.ndindex(16, 16, 16):
        tree.updateNode([3.3 + 0.2 * x, 0.1 + 0.2 * y, 0.1 + 0.2 * z], False)
    tree.updateInnerOccupancy()
    tree.write(str(tmp_path / "own.ot"))
    found = read_octomap(tmp_path / "own.ot")
    assert found.voxel_size == 0.2
    assert as_dict(found) == pytest.approx(leaves_of(read_tree(octomap, tmp_path / "own.ot")), abs=1e-6)
    assert found.voxels == len(voxels_of(as_dict(found)))
    assert found.level.max() >= 3


def as_dict(leaves: OctomapLeaves) -> dict[tuple[tuple[int, ...], int], float]:
    """As :func:`leaves_of`; the lower voxel bit by bit."""
    lower = [[sum((c >> 3 * bit + axis & 1) << bit for bit in range(16)) - 32768 for axis in range(3)]
             for c in leaves.code.tolist()]  # fmt: skip
    sides = (2 ** leaves.level.astype(int)).tolist()
    return {(tuple(v), side): p for v, side, p in zip(lower, sides, leaves.log_odds.tolist(), strict=True)}


def test_the_curve_counts_every_bit() -> None:
    random = np.random.default_rng(1)
    cells = random.integers(0, 65536, (200, 3))
    codes = z_order(cells)
    for axis in range(3):
        bits = [sum((code >> 3 * bit + axis & 1) << bit for bit in range(16)) for code in codes.tolist()]
        np.testing.assert_array_equal(bits, cells[:, axis])
    np.testing.assert_array_equal(bricks_of_codes(codes), (cells - 32768) // BRICK)


def test_a_map_beyond_octomaps_reach() -> None:
    brick_codes(np.array([[4095, -4096, 0]], np.int32))
    with pytest.raises(CapacityError, match="32768 voxels"):
        brick_codes(np.array([[4096, 0, 0]], np.int32))


def run_import(*arguments: object) -> int:
    return carry_out("import", *arguments)


@pytest.mark.parametrize("name", ["map.ot", "map.bt"])
def test_a_map_goes_out_and_comes_in_again(
    hand: HandMap, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (write_ot if name == "map.ot" else write_bt)(tmp_path / name, hand)
    assert run_import(tmp_path / name, "--out", tmp_path / "back.npz", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    back = LogOddsMap.load(tmp_path / "back.npz")
    wanted = known_voxels(hand)
    found = known_voxels(back)
    assert found.keys() == wanted.keys()
    assert facts["occupied"] + facts["free"] == len(wanted)
    assert facts["occupied"] == sum(p > 0.5 for p in wanted.values())
    p = np.array(list(wanted.values()))
    if name == "map.bt":
        p = np.where(p > 0.5, 0.971, 0.1192)
    np.testing.assert_allclose([found[v] for v in wanted], p, rtol=1e-5, atol=1e-7)


def test_a_node_of_log_odds_zero_is_known(octomap: ModuleType, tmp_path: Path) -> None:
    tree = octomap.OcTree(0.1)
    tree.updateNode([0.05, 0.05, 0.05], True).setLogOdds(0.0)
    tree.write(str(tmp_path / "zero.ot"))
    run_import(tmp_path / "zero.ot", "--out", tmp_path / "zero.npz")
    assert LogOddsMap.load(tmp_path / "zero.npz").state(
        [[0.05, 0.05, 0.05], [0.15, 0.05, 0.05]]
    ).tolist() == [2, 0]


@pytest.mark.shared_data
def test_freiburgs_building_79(
    octomap: ModuleType, shared_data: Path, tmp_path: Path, backend: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source = shared_data / "octomap" / "geb079.bt"
    leaves = read_octomap(source)
    tree = read_tree(octomap, source, 0.08)
    theirs = [(*leaf.getCoordinate(), leaf.getSize()) for leaf in tree.begin_leafs()]  # type: ignore[attr-defined]
    middle, size = np.array(theirs)[:, :3], np.array(theirs)[:, 3]
    assert len(theirs) == len(leaves.code)
    wanted = z_order(np.rint((middle - size[:, None] / 2) / 0.08).astype(np.int64) + 32768)
    order, ours = np.argsort(wanted), np.argsort(leaves.code)
    np.testing.assert_array_equal(leaves.code[ours], wanted[order])
    np.testing.assert_array_equal(
        2 ** leaves.level[ours].astype(int), np.rint(size / 0.08).astype(int)[order]
    )
    run_import(source, "--out", tmp_path / "geb079.npz")
    assert f"{len(theirs):,} OctoMap leaves" in capsys.readouterr().out
    m = LogOddsMap.load(tmp_path / "geb079.npz")
    assert m.voxel_size == 0.08
    # Every leaf is known, and occupied where OctoMap says so; and nothing else is known.
    some = np.random.default_rng(0).choice(len(theirs), 3000, replace=False)
    nodes = [tree.search(middle[i].tolist()) for i in some]  # type: ignore[attr-defined]
    occupied = np.array([tree.isNodeOccupied(node) for node in nodes])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(m.state(middle[some] - 0.02), np.where(occupied, 2, 1))
    assert 0.05 < occupied.mean() < 0.95
    states = np.zeros(3, np.int64)
    for _, _, state in BrickReader(m).batches(known_bricks(m)):
        states += np.bincount(state.ravel(), minlength=3)
    assert states[1] + states[2] == np.rint((size / 0.08) ** 3).sum() == leaves.voxels
    write_bt(tmp_path / "again.bt", m)
    data = [path.read_bytes().partition(b"\ndata\n")[2] for path in (source, tmp_path / "again.bt")]
    assert data[0] == data[1]


HEADER = b"# Octomap OcTree file\n#\nid OcTree\nsize 2\nres 0.1\ndata\n"
BINARY = HEADER.replace(b"OcTree file", b"OcTree binary file")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"ply\nformat ascii 1.0\n", "not an OctoMap file"),
        (b"", "not an OctoMap file"),
        (HEADER.replace(b"res 0.1\n", b""), "lacks a resolution"),
        (HEADER.replace(b"size 2", b"size many"), "lacks a resolution or a size"),
        (HEADER.replace(b"0.1", b"-1"), "-1.0 m is not valid"),
        (HEADER.replace(b"id OcTree", b"id CountingOcTree"), "unsupported kind of tree CountingOcTree"),
        (HEADER + b"\0\0\0\0\xff", "end too early"),
        (HEADER, "end too early"),
        (HEADER + b"\0\0\0\0\x01" * 40, "do not form a tree"),
        (BINARY + b"\x03", "end too early"),
        (BINARY + b"\x03\0" * 40, "do not form a tree"),
        (HEADER + b"\0\0\0\0\0", "it has 1 nodes, but 2 by its header"),
        (BINARY + b"\x05\0", "it has 3 nodes, but 2 by its header"),
        (HEADER + b"\0\0\0\0\x01\0\0\xc0\x7f\0", "a node's value is not finite"),
    ],
)
def test_files_that_cannot_be_read(tmp_path: Path, content: bytes, problem: str) -> None:
    (tmp_path / "bad.ot").write_bytes(content)
    with pytest.raises(MapFileError, match=rf"bad\.ot: .*{problem}"):
        read_octomap(tmp_path / "bad.ot")


def test_files_that_are_not_there_and_names_that_are_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"gone\.bt: there is no such file"):
        read_octomap(tmp_path / "gone.bt")
    with pytest.raises(ConfigError, match=r"map\.bt: --out must end in \.npz"):
        run_import(tmp_path / "gone.bt", "--out", tmp_path / "map.bt")


def test_a_leaf_that_stands_for_more_voxels_than_there_is_memory_for(tmp_path: Path) -> None:
    """Two nodes, eight bytes: an eighth of the whole octree is free."""
    (tmp_path / "vast.bt").write_bytes(BINARY + b"\x01\0")
    leaves = read_octomap(tmp_path / "vast.bt")
    assert leaves.voxels == 32768**3
    with pytest.raises(CapacityError, match="million voxels, in 1 OctoMap leaves, would need"):
        leaves.bricks()


def test_nodes_are_in_pre_order(hand: HandMap) -> None:
    nodes = octree_of(hand, only_state=False)
    stack: list[tuple[int, int]] = [(0, 16)]
    for code, level, children in zip(
        nodes.code.tolist(), nodes.level.tolist(), nodes.children.tolist(), strict=True
    ):
        assert stack.pop() == (code, level)
        below = [child for child in range(8) if children >> child & 1]
        stack += [(code | child << 3 * (level - 1), level - 1) for child in reversed(below)]
    assert not stack
