"""Random numbers that depend on a seed, a stream and a counter alone, whichever thread asks for them."""

import taichi as ti

from taichi_mrf.kernels.types import F32, Template


@ti.func
def mixed(x: ti.u32) -> ti.u32:
    """A permutation of 32 bits in which each bit of ``x`` sways every other (xorshift and multiply)."""
    x ^= x >> 16
    x *= ti.u32(0x7FEB352D)
    x ^= x >> 15
    x *= ti.u32(0x846CA68B)
    x ^= x >> 16
    return x


@ti.func
def random_bits(seed: Template, stream: Template, counter: ti.i64, purpose: Template) -> ti.u32:
    """32 random bits: number ``counter`` of a stream, for one of several purposes."""
    low, high = ti.cast(counter, ti.u32), ti.cast(counter >> 32, ti.u32)
    key = mixed(mixed(ti.cast(seed, ti.u32)) + ti.cast(stream, ti.u32))
    return mixed(mixed(mixed(key + low) + high) + ti.cast(purpose, ti.u32))


@ti.func
def uniform(bits: ti.u32) -> F32:
    """24 of the bits as a number above 0, up to 1: its logarithm is finite."""
    return (ti.cast(bits >> 8, ti.f32) + 1.0) * ti.static(2.0**-24)
