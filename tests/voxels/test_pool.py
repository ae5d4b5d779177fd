"""The pool of bricks: it grows, keeps what it holds, gives slots back, and says when it cannot grow."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from refusals import refusal

from taichi_mrf.errors import CapacityError
from taichi_mrf.voxels import pool as pool_module
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

PRIOR = -2.25


def some_bricks(count: int, first: int = 0) -> NDArray[np.int32]:
    """Different coordinates, negative ones among them."""
    return np.stack([np.arange(count) + first, -np.arange(count), np.full(count, 7)], axis=1).astype(np.int32)


def beliefs(pool: BrickPool) -> NDArray[np.float32]:
    """(capacity, 512)."""
    return pool.belief.to_numpy()[: pool.capacity * VOXELS].reshape(-1, VOXELS)


def write(pool: BrickPool, slots: NDArray[np.int32], value: float) -> None:
    values = beliefs(pool)
    values[slots] = value + slots[:, None] + np.arange(VOXELS) / VOXELS
    pool.belief.from_numpy(values.reshape(-1))


def own(pool: BrickPool, slots: NDArray[np.int32]) -> None:
    pool.owners[slots] += 1


def test_new_bricks_are_at_the_prior_and_owned_by_nobody() -> None:
    pool = BrickPool(PRIOR)
    slots = pool.allocate(some_bricks(5))
    assert slots.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(pool.bricks[slots], some_bricks(5))
    assert (beliefs(pool)[slots] == PRIOR).all()
    assert (pool.owners[slots] == 0).all()
    assert len(pool.in_use) == 0
    own(pool, slots[1:3])
    assert pool.in_use.tolist() == [1, 2]


def test_growth_keeps_values_coordinates_owners_and_identities() -> None:
    pool = BrickPool(PRIOR)
    slots = pool.allocate(some_bricks(200))
    own(pool, slots)
    write(pool, slots, 10)
    pool.keep_evidence().fill(0.5)
    before, identity, capacity = beliefs(pool)[slots].copy(), pool.identity[slots].copy(), pool.capacity
    more = pool.allocate(some_bricks(3000, first=500))
    assert pool.capacity > capacity
    assert len(np.intersect1d(slots, more)) == 0
    np.testing.assert_array_equal(beliefs(pool)[slots], before)
    np.testing.assert_array_equal(pool.bricks[slots], some_bricks(200))
    np.testing.assert_array_equal(pool.identity[slots], identity)
    assert (beliefs(pool)[more] == PRIOR).all()
    assert pool.evidence is not None
    evidence = pool.evidence.to_numpy().reshape(-1, VOXELS)
    assert (evidence[slots] == 0.5).all()
    assert (evidence[more] == PRIOR).all()
    assert pool.in_use.tolist() == slots.tolist()


def test_a_slot_that_comes_back_is_at_the_prior_again_in_both_channels() -> None:
    pool = BrickPool(PRIOR)
    slots = pool.allocate(some_bricks(10))
    pool.keep_evidence().fill(3.0)
    write(pool, slots, 5)
    pool.release(slots[2:6])
    again = pool.allocate(some_bricks(3, first=90))
    assert again.tolist() == [2, 3, 4]  # the lowest free slots first
    np.testing.assert_array_equal(pool.bricks[again], some_bricks(3, first=90))
    assert pool.evidence is not None
    for values in (beliefs(pool), pool.evidence.to_numpy().reshape(-1, VOXELS)):
        assert (values[again] == PRIOR).all()
        assert (values[[0, 1, 6, 7, 8, 9]] != PRIOR).all()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 40), st.randoms()), max_size=25))
@settings(max_examples=40)
def test_slots_and_identities_over_any_history(history: list) -> None:
    """No slot has two bricks, no identity is given twice, and the slots in use are those that are owned."""
    pool = BrickPool(PRIOR)
    held: dict[int, tuple] = {}
    identities: list[int] = []
    for number, (add, count, random) in enumerate(history):
        if add:
            bricks = some_bricks(count, first=100 * number)
            slots = pool.allocate(bricks)
            assert not held.keys() & set(slots.tolist())
            held.update(zip(slots.tolist(), map(tuple, bricks.tolist()), strict=True))
            identities += pool.identity[slots].tolist()
            own(pool, slots)
        else:
            gone = random.sample(sorted(held), min(count, len(held)))
            pool.release(np.array(gone, np.int32))
            assert (pool.identity[gone] == -1).all()
            for slot in gone:
                del held[slot]
        assert pool.in_use.tolist() == sorted(held)
        assert {slot: tuple(pool.bricks[slot].tolist()) for slot in held} == held
    assert len(set(identities)) == len(identities)
    assert min(identities, default=0) >= 0


def test_no_growth_over_a_hundred_rounds() -> None:
    pool = BrickPool(PRIOR)
    own(pool, pool.allocate(some_bricks(300)))
    first = pool.allocate(some_bricks(250, first=1000))
    own(pool, first)
    pool.release(first)
    capacity, elements = pool.capacity, pool.belief.shape
    for _ in range(100):
        slots = pool.allocate(some_bricks(250, first=1000))
        assert slots.tolist() == first.tolist()  # equal histories give equal pools
        own(pool, slots)
        pool.release(slots)
    assert (pool.capacity, pool.belief.shape) == (capacity, elements)


def test_restart_goes_back_to_the_prior_or_to_the_evidence() -> None:
    pool = BrickPool(PRIOR)
    slots = pool.allocate(some_bricks(3))
    write(pool, slots, 1)
    pool.restart()
    assert (beliefs(pool) == PRIOR).all()
    evidence = np.random.default_rng(0).normal(size=pool.capacity * VOXELS).astype(np.float32)
    pool.keep_evidence().from_numpy(evidence)
    pool.restart()
    np.testing.assert_array_equal(pool.belief.to_numpy(), evidence)
    write(pool, slots, 1)  # the channels are two arrays, not one
    np.testing.assert_array_equal(pool.keep_evidence().to_numpy(), evidence)


def test_too_many_bricks_for_the_memory_limit_say_how_much_and_leave_the_pool_alone() -> None:
    limit = 1000 * VOXELS * 4 / 1e9
    pool = BrickPool(PRIOR, memory_limit_gb=limit)
    slots = pool.allocate(some_bricks(700))
    own(pool, slots)
    write(pool, slots, 2)
    before, capacity = beliefs(pool).copy(), pool.capacity
    wanted = 700 + 1500
    with refusal(
        CapacityError,
        f"{wanted * VOXELS / 1e6:.3g} million voxels",
        f"{wanted * VOXELS * 4 / 1e9:.3g} GB",
        f"{limit:.3g} GB",
    ):
        pool.allocate(some_bricks(1500, first=5000))
    assert pool.capacity == capacity
    np.testing.assert_array_equal(beliefs(pool), before)
    assert len(pool.allocate(some_bricks(200, first=9000))) == 200  # what fits still goes in


def test_more_voxels_than_an_array_can_have_is_an_error_and_not_an_attempt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert pool_module.MOST_BRICKS * VOXELS < 2**31
    monkeypatch.setattr(pool_module, "MOST_BRICKS", 400)
    pool = BrickPool(PRIOR)
    assert len(pool.allocate(some_bricks(390))) == 390
    assert len(pool.allocate(some_bricks(10, first=500))) == 10  # up to the last one
    with refusal(CapacityError, f"{600 * VOXELS:.3g} voxels, but at most {400 * VOXELS:.3g} are possible"):
        pool.allocate(some_bricks(200, first=900))


def test_an_empty_request_takes_nothing() -> None:
    pool = BrickPool(PRIOR)
    assert pool.allocate(np.zeros((0, 3), np.int32)).tolist() == []
    assert pool.capacity == 0
    assert len(pool.in_use) == 0
