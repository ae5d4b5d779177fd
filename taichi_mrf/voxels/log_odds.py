"""Probabilities and their logarithms, kept precise near 0 and 1 and cheap where most voxels are."""

from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, Template

MOVED = 0.01
"""A marginal that changes by more than this counts as moved (the residual of a sweep)."""


@ti.func
def logistic(x: F32) -> F32:
    """Log-odds to probability."""
    return 1.0 / (1.0 + ti.exp(-x))


@ti.func
def softplus(x: F32) -> F32:
    """log(1 + e^x) without losing the digits of a small e^x: minus the log of being free."""
    grown = ti.exp(-ti.abs(x))
    tail = grown * (1.0 - grown * (0.5 - grown * (1.0 / 3.0)))
    if grown >= 1e-2:
        tail = ti.log(1.0 + grown)
    return ti.max(x, 0.0) + tail


@ti.func
def log_let_through(x: F32, log_pass: F32, passes: Template) -> F32:
    """log(1 - (1 - s) m) for log-odds ``x`` of m: a voxel lets a ray through if it is free, and with the
    chance s, whose logarithm is ``log_pass``, if it is occupied. Without ``passes`` s is 0."""
    let_through = -softplus(x)
    if ti.static(passes):
        let_through += softplus(x + log_pass)
    return let_through


@ti.func
def exp_of_negative(x: F32) -> F32:
    """e^x for x <= 0, by its series near 0: most voxels on a ray's way are nearly free."""
    value = 1.0 + x * (1.0 + x * (0.5 + x * (1.0 / 6.0)))
    if x <= -0.05:
        value = ti.exp(x)
    return value


@ti.func
def clamped_log_odds(occupied: F32, empty: F32, clamp: F32, largest: F32) -> F32:
    """log(occupied / empty), clamped, and moved from [-clamp, clamp] to [0, 1] for the accumulators.

    ``largest`` is e^clamp: most messages lie beyond the clamp, where no logarithm need be taken.
    """
    message = 1.0
    if occupied * largest <= empty:
        message = 0.0
    elif occupied < empty * largest:
        message = 0.5 + 0.5 * ti.log(occupied / empty) / clamp
    return message


@ti.func
def faded(evidence: F32, kept: F32, left: F32, appeared: F32) -> F32:
    """Evidence of the past, as log-odds, for a state that may have changed since (a binary channel).

    ``left`` is the chance that what is free now was occupied then, ``appeared`` the chance that what is
    occupied now was free then, and ``kept`` the rest of 1. No evidence stays none, and certainty becomes
    ``-log(left)`` or ``log(appeared)``.
    """
    small = ti.exp(-ti.abs(evidence))
    # kept + left is 1 - appeared, with all its digits where nearly everything is forgotten.
    occupied, free = kept + left + appeared * small, left + (kept + appeared) * small
    if evidence < 0.0:
        occupied, free = (kept + left) * small + appeared, kept + appeared + left * small
    return ti.log(occupied / free)


@ti.func
def moves(log_odds: F32, change: F32) -> I32:
    """True if a marginal changes by more than MOVED; never by more than a quarter of its log-odds' change."""
    far = 0
    if ti.abs(change) > 4.0 * MOVED:
        far = ti.abs(logistic(log_odds + change) - logistic(log_odds)) > MOVED
    return far
