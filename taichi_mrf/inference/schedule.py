"""In which order keyframes are swept, and how often.

Loopy belief propagation that stops after a few sweeps depends on its initial messages and on their order. A
map must depend on neither: full inference starts without messages and orders the keyframes by their content,
so any history of adding, removing and moving keyframes ends in the map of the final set.
"""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.kernels.resident import on_host
from taichi_mrf.system import runtime
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool


@dataclass(frozen=True)
class InferProgress:
    """Where inference stands, after each keyframe: both counts start at 1."""

    sweep: int
    sweeps: int
    keyframe: int
    keyframes: int
    rays: int


@dataclass(frozen=True)
class InferReport:
    """What inference did. ``residual`` is the share of the voxels seen whose marginal moved by more than
    0.01 in the last sweep; ``complete`` is False if a progress callback stopped it."""

    seconds: float
    residual: float
    sweeps: int
    rays: int
    complete: bool


Progress = Callable[[InferProgress], bool]


def content_key(keyframe: Keyframe) -> bytes:
    """What a keyframe holds, as bytes to sort by: measurement, pose and camera, but not its number."""
    digest = hashlib.blake2b(keyframe.T_world_camera.tobytes(), digest_size=16)
    digest.update(repr(keyframe.camera).encode())
    digest.update(on_host(keyframe.image.depth).tobytes())
    return digest.digest()


def run_sweeps(
    keyframes: Sequence[Keyframe],
    pool: BrickPool,
    sweeper: Sweeper,
    sweeps: int,
    tolerance: float,
    progress: Progress | None = None,
) -> InferReport:
    """Sweep over keyframes in the given order (Gauss-Seidel: each sees what the last has changed).

    Stops after ``sweeps``, or when the residual is at most ``tolerance`` (above 0), or, between two
    keyframes, when ``progress`` returns False.
    """
    begin = time.perf_counter()
    damping = sweeper.inference.damping
    residual, rays, done, complete = 0.0, 0, 0, True
    for sweep in range(1, sweeps + 1):
        moved = seen = 0
        swept: list[Keyframe] = []
        try:
            for number, keyframe in enumerate(keyframes, start=1):
                if not _has_converged(keyframe, pool, damping) and sweeper.sweep(keyframe, pool):
                    swept.append(keyframe)
                rays += keyframe.rays
                if progress is not None and not progress(
                    InferProgress(sweep, sweeps, number, len(keyframes), keyframe.rays)
                ):
                    complete = False
                    break
        finally:  # the beliefs have changed, even if ``progress`` raised
            # Only now does the host ask, and wait for, what came of it.
            for keyframe in swept:
                changed = sweeper.take_moved(keyframe, pool)
                moved += int(changed.sum())
                seen += len(changed) * VOXELS
        residual, done = moved / max(seen, 1), sweep
        if not complete or residual <= tolerance > 0:
            break
    runtime.settle()
    return InferReport(time.perf_counter() - begin, residual, done, rays, complete)


def _has_converged(keyframe: Keyframe, pool: BrickPool, damping: float) -> bool:
    """Whether a sweep over this keyframe would send the very messages that it has sent.

    They follow from the cavity, which is what all *others* believe: if no belief has changed since this
    keyframe's own last sweep, the cavity has not.
    """
    return damping == 0 and keyframe.messages is not None and keyframe.revision == pool.revision
