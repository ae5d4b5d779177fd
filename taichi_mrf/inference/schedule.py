"""In which order keyframes are swept, and how often.

Loopy belief propagation that stops after a few sweeps depends on its initial messages and on their order. A
map must depend on neither: full inference starts without messages and orders the keyframes by their content,
so any history of adding, removing and moving keyframes ends in the map of the final set.
"""

import hashlib
import struct
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.system import runtime
from taichi_mrf.system.resident import on_host
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool


@dataclass(frozen=True)
class InferProgress:
    """Progress of inference, after each keyframe: both counts start at 1."""

    sweep: int
    sweeps: int
    keyframe: int
    keyframes: int
    rays: int


@dataclass(frozen=True)
class InferReport:
    """Result of inference. ``residual`` is the share of the voxels seen whose marginal moved by more than
    0.01 in the last sweep; ``complete`` is False if a progress callback stopped it."""

    seconds: float
    residual: float
    sweeps: int
    rays: int
    complete: bool


Progress = Callable[[InferProgress], bool]

NoteSweep = Callable[[Keyframe, NDArray[np.int32]], object]
"""Called after a sweep over a keyframe with how many marginals have moved in each of its bricks, (n,)."""

InferSteps = Generator[InferProgress, None, InferReport]
"""Inference step by step: it yields after each keyframe. StopRequestedError, thrown in, ends it early."""

StepT = TypeVar("StepT")
OutcomeT = TypeVar("OutcomeT")


class StopRequestedError(Exception):
    """Thrown into a generator of steps to stop it, which then cleans up and returns. ``at_once``: there is no
    time for more steps."""

    def __init__(self, at_once: bool = False) -> None:
        super().__init__("stopped")
        self.at_once = at_once


def driven(
    steps: Generator[StepT, None, OutcomeT], progress: Callable[[StepT], bool] | None = None
) -> OutcomeT:
    """Take all steps and return the outcome. ``progress`` is called after each; returning False stops."""
    try:
        step = next(steps)
        while True:
            go_on = progress is None or progress(step)
            step = next(steps) if go_on else steps.throw(StopRequestedError())
    except StopIteration as end:
        outcome: OutcomeT = end.value
        return outcome
    finally:
        steps.close()


def content_key(keyframe: Keyframe) -> bytes:
    """Content of a keyframe, as bytes to sort by: measurement, pose, camera and what it states of its
    measurements, but not its number. Of keyframes that are the same, their stamps decide."""
    digest = hashlib.blake2b(keyframe.T_world_camera.tobytes(), digest_size=16)
    digest.update(repr(keyframe.camera).encode())
    digest.update(on_host(keyframe.image.depth).tobytes())
    digest.update(keyframe.own.content())
    return digest.digest() + struct.pack(">d", keyframe.stamp_s)


def sweep_steps(
    keyframes: Sequence[Keyframe],
    pool: BrickPool,
    sweeper: Sweeper,
    sweeps: int,
    tolerance: float,
    note_sweep: NoteSweep | None = None,
) -> InferSteps:
    """Sweep over keyframes in the given order (Gauss-Seidel: each sees what the last has changed).

    Stops after ``sweeps``, or when the residual is at most ``tolerance`` (above 0), or, between two
    keyframes, on StopRequestedError.
    """
    begin = time.perf_counter()
    residual, rays, done, complete = 0.0, 0, 0, True
    for sweep in range(1, sweeps + 1):
        moved = seen = 0
        swept: list[Keyframe] = []
        try:
            for number, keyframe in enumerate(keyframes, start=1):
                if not _has_converged(keyframe, pool) and sweeper.sweep(keyframe, pool):
                    swept.append(keyframe)
                rays += keyframe.rays
                yield InferProgress(sweep, sweeps, number, len(keyframes), keyframe.rays)
        except StopRequestedError:
            complete = False
        finally:  # the beliefs have changed, even if the caller has failed
            # Only now does the host ask, and wait for, what came of it.
            for keyframe in swept:
                changed = sweeper.take_moved(keyframe, pool)
                if note_sweep is not None:
                    note_sweep(keyframe, changed)
                moved += int(changed.sum())
                seen += len(changed) * VOXELS
        residual, done = moved / max(seen, 1), sweep
        if not complete or residual <= tolerance > 0:
            break
    runtime.settle()
    return InferReport(time.perf_counter() - begin, residual, done, rays, complete)


def _has_converged(keyframe: Keyframe, pool: BrickPool) -> bool:
    """True if a sweep over this keyframe would send the very messages that it has sent.

    They follow from the cavity, which is what all *others* believe: if no belief has changed since this
    keyframe's own last sweep, the cavity has not.
    """
    return keyframe.messages is not None and keyframe.revision == pool.revision
