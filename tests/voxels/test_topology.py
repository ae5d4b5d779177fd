"""The index of bricks: sparse and dense kinds do what a dictionary would do, within their bounds."""

import gc
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal

from taichi_mrf.errors import CapacityError
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.system import compiler
from taichi_mrf.voxels.layout import BRICK, CHUNK
from taichi_mrf.voxels.topology import DenseTopology, SparseTopology, Topology, create_topology, recycle

pytestmark = pytest.mark.backends

SIDE = 64
"""Bricks along each side of the dense volume."""

Bricks = NDArray[np.int32]

reachable = st.integers(-SIDE // 2, SIDE // 2 - 1)
some_bricks = st.lists(st.tuples(reachable, reachable, reachable), max_size=12, unique=True)
few_bricks = st.lists(st.sampled_from([(x, y, -z) for x in (-9, -1, 0) for y in (0, 7) for z in (1, 8)]),
                      max_size=8, unique=True)  # fmt: skip
steps = st.lists(
    st.tuples(st.sampled_from(["insert", "erase", "cross", "uncross"]), some_bricks | few_bricks), max_size=12
)


@pytest.fixture(scope="module", params=["sparse", "dense"])
def index(request: pytest.FixtureRequest, backend: str) -> Topology:
    """Both kinds, where the backend has them; one for all tests here, because compilation is slow."""
    if request.param == "dense":
        return DenseTopology(SIDE)
    if backend == "vulkan":
        pytest.skip("Vulkan has no sparse SNodes")
    return SparseTopology()


@pytest.fixture
def topology(index: Topology) -> Topology:
    """Empty, and anchored at the origin."""
    return emptied(index)


def emptied(topology: Topology, anchor: tuple[int, int, int] = (0, 0, 0)) -> Topology:
    topology.clear()
    topology.anchor(np.array(anchor, np.int32))
    return topology


def array(bricks: list[tuple[int, int, int]]) -> Bricks:
    return np.array(bricks, np.int32).reshape(-1, 3)


def block(corner: tuple[int, int, int], side: int = 2 * CHUNK) -> Bricks:
    """All bricks of a cube."""
    return np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1).astype(np.int32) + array(
        [corner]
    )


@given(steps)
@settings(max_examples=60)
def test_it_is_a_dictionary(index: Topology, history: list[tuple[str, list]]) -> None:
    topology = emptied(index)
    slots: dict[tuple, int] = {}
    crossings: defaultdict[tuple, int] = defaultdict(int)
    everywhere = {brick for _, bricks in history for brick in bricks} | {(0, 0, 0), (-1, -1, -1)}
    born = 0
    for verb, bricks in history:
        if verb == "insert":
            new = np.arange(born, born + len(bricks), dtype=np.int32)
            topology.insert(array(bricks), new)
            slots.update(zip(bricks, new.tolist(), strict=True))
            born += len(bricks)
        elif verb == "erase":
            topology.erase(array(bricks))
            for brick in bricks:
                slots.pop(brick, None)
        else:
            seen = bricks if verb == "cross" else [b for b in bricks if crossings[b] > 0]
            number = 1 if verb == "cross" else -1
            topology.add_crossings(array(seen), number)
            for brick in seen:
                crossings[brick] += number
        asked = sorted(everywhere)
        assert topology.slots(array(asked)).tolist() == [slots.get(b, -1) for b in asked]
        assert topology.crossings(array(asked)).tolist() == [crossings[b] for b in asked]


@pytest.mark.parametrize("corner", [(0, 0, 0), (-8, -8, -8), (-17, 3, -5)])
def test_blocks_of_bricks_across_chunks_come_and_go(topology: Topology, corner: tuple[int, int, int]) -> None:
    """Every brick for itself: erasing or uncrossing some leaves their neighbours in the chunk alone."""
    bricks = block(corner)
    random = np.random.default_rng(0)
    slots = random.permutation(len(bricks)).astype(np.int32)
    topology.insert(bricks, slots)
    topology.add_crossings(bricks, 1)
    np.testing.assert_array_equal(topology.slots(bricks), slots)
    gone = random.random(len(bricks)) < 0.5
    topology.erase(bricks[gone])
    np.testing.assert_array_equal(topology.slots(bricks), np.where(gone, -1, slots))
    assert (topology.crossings(bricks) == 1).all()
    topology.add_crossings(bricks, -1)
    np.testing.assert_array_equal(topology.slots(bricks), np.where(gone, -1, slots))
    assert (topology.crossings(bricks) == 0).all()
    topology.insert(bricks[gone], slots[gone])
    np.testing.assert_array_equal(topology.slots(bricks), slots)
    assert (topology.slots(block(corner) + array([(16, 0, 0)])) == -1).all()


@pytest.mark.parametrize("anchor", [(3000, -3500, 4050), (-4060, 12, 2047)])
def test_thousands_of_bricks_away(index: Topology, anchor: tuple[int, int, int]) -> None:
    topology = emptied(index, anchor)
    bricks = block(anchor, side=CHUNK)
    topology.check(bricks, 0.02)
    topology.insert(bricks, np.arange(len(bricks), dtype=np.int32))
    topology.add_crossings(bricks[::3].copy(), 1)
    np.testing.assert_array_equal(topology.slots(bricks), np.arange(len(bricks)))
    np.testing.assert_array_equal(topology.crossings(bricks), np.arange(len(bricks)) % 3 == 0)
    assert (topology.slots(block((0, 0, 0))) == -1).all()
    assert (topology.crossings(block((0, 0, 0))) == 0).all()


def test_the_sparse_index_spans_both_places_at_once(backend: str) -> None:
    if backend == "vulkan":
        pytest.skip("Vulkan has no sparse SNodes")
    topology = SparseTopology()
    most = topology.HALF_SPAN - 1
    bricks = array([(-most - 1, 0, 0), (most, most, most), (0, -most - 1, most), (-1, -1, -1)])
    topology.check(bricks, 0.05)
    topology.insert(bricks, np.array([5, 6, 7, 8], np.int32))
    assert topology.slots(bricks).tolist() == [5, 6, 7, 8]


@pytest.mark.parametrize("far", [10**4, 10**6, 2**31 - 1, -(10**4), -(2**31)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_lookups_beyond_the_span_find_nothing(topology: Topology, far: int, axis: int) -> None:
    everywhere = block((-8, -8, -8))
    topology.insert(everywhere, np.zeros(len(everywhere), np.int32))
    topology.add_crossings(everywhere, 1)
    asked = np.zeros((1, 3), np.int32)
    asked[0, axis] = far
    assert topology.slots(asked).tolist() == [-1]
    assert topology.crossings(asked).tolist() == [0]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_bound_is_an_error_in_metres(topology: Topology, axis: int, sign: int) -> None:
    half = topology.HALF_SPAN if isinstance(topology, SparseTopology) else SIDE // 2
    at_edge = np.zeros((1, 3), np.int32)
    at_edge[0, axis] = half - 1 if sign > 0 else -half
    topology.check(at_edge, 0.02)
    metres = half * BRICK * 0.02 * (1 if isinstance(topology, SparseTopology) else 2)
    with refusal(CapacityError, f" {metres:g} m"):
        topology.check(np.concatenate([at_edge, at_edge + sign * np.eye(3, dtype=np.int32)[[axis]]]), 0.02)
    topology.check(np.zeros((0, 3), np.int32), 0.02)


def test_a_brick_outside_the_dense_volume_is_not_inserted_as_another(backend: str) -> None:
    """(0, 0, SIDE) of the array is the same number as (0, 1, 0)."""
    topology = emptied(DenseTopology(SIDE))
    lowest = -SIDE // 2
    outside, its_double = array([(lowest, lowest, lowest + SIDE)]), array([(lowest, lowest + 1, lowest)])
    with pytest.raises(CapacityError):
        topology.check(outside, 0.02)
    topology.insert(outside, np.array([3], np.int32))
    assert topology.slots(its_double).tolist() == [-1]


def test_the_dense_volume_lies_around_its_first_anchor_only(backend: str) -> None:
    topology = emptied(DenseTopology(SIDE), (1000, -1000, 5))
    topology.anchor(np.array([0, 0, 0], np.int32))
    topology.check(array([(1000, -1000, 5)]), 0.02)
    with pytest.raises(CapacityError, match=f"dense_bricks \\(now {SIDE}\\)"):
        topology.check(array([(0, 0, 0)]), 0.02)


def test_clear_forgets_slots_and_crossings(topology: Topology) -> None:
    bricks = block((-8, -8, -8))
    topology.insert(bricks, np.arange(len(bricks), dtype=np.int32))
    topology.add_crossings(bricks, 1)
    emptied(topology)
    assert (topology.slots(bricks) == -1).all()
    assert (topology.crossings(bricks) == 0).all()
    topology.insert(bricks[:1], np.array([9], np.int32))
    assert topology.slots(bricks[:2]).tolist() == [9, -1]
    assert topology.crossings(bricks[:2]).tolist() == [0, 0]


def test_a_recycled_index_comes_back_empty(backend: str) -> None:
    used = create_topology(backend, SIDE)
    used.anchor(np.zeros(3, np.int32))
    bricks = block((0, 0, 0))
    used.insert(bricks, np.arange(len(bricks), dtype=np.int32))
    used.add_crossings(bricks, 1)
    recycle(used)
    again = create_topology(backend, SIDE)
    again.anchor(np.zeros(3, np.int32))
    assert again is used
    assert (again.slots(bricks) == -1).all()
    assert (again.crossings(bricks) == 0).all()


def test_as_many_maps_as_there_are_layers_stay_apart(backend: str) -> None:
    """Ten trees of pointers in one process used to crash it, and Quadrants corrupts memory at over 2,048
    SNodes (its issue 815); now all maps share one tree."""
    if backend == "vulkan":
        pytest.skip("Vulkan has no sparse SNodes")
    bricks = block((0, 0, 0))
    kept = [SparseTopology()]
    trees = compiler.program().get_snode_tree_size()
    kept += [SparseTopology() for _ in range(199)]
    assert compiler.program().get_snode_tree_size() == trees
    for number, topology in enumerate(kept):
        topology.insert(bricks, np.full(len(bricks), number, np.int32))
    for number, topology in enumerate(kept):
        assert (topology.slots(bricks) == number).all()


def test_a_layer_can_be_had_again_and_is_empty_then(backend: str) -> None:
    if backend == "vulkan":
        pytest.skip("Vulkan has no sparse SNodes")
    bricks = block((0, 0, 0))
    used = set()
    for _ in range(3 * 256):
        topology = SparseTopology()
        used.add(topology.layer)
        assert (topology.slots(bricks) == -1).all()
        topology.insert(bricks, np.arange(len(bricks), dtype=np.int32))
        del topology
    assert len(used) == 1


def test_more_maps_than_layers_are_an_error(backend: str) -> None:
    if backend == "vulkan":
        pytest.skip("Vulkan has no sparse SNodes")
    kept: list[SparseTopology] = []
    with pytest.raises(CapacityError, match="256 maps already"):
        kept.extend(SparseTopology() for _ in range(257))


def test_maps_that_nobody_can_reach_do_not_count(backend: str) -> None:
    """Those in cycles, as the traceback of an exception makes them, until the collector comes by."""
    gc.collect()
    kept: list[SparseTopology] = []
    if backend != "vulkan":  # there each map has an index of its own, and no more than memory has room for
        kept.append(SparseTopology())
        assert SparseTopology.tree is not None
        kept += [SparseTopology() for _ in SparseTopology.tree.unused[2:]]
    gc.disable()
    try:
        for _ in range(4):
            cycle: list[object] = [MRFMap(voxel_size=0.1)]
            cycle.append(cycle)
    finally:
        gc.enable()


def test_each_backend_gets_its_kind(backend: str) -> None:
    kind = DenseTopology if backend == "vulkan" else SparseTopology
    assert isinstance(create_topology(backend, SIDE), kind)
