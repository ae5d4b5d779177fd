"""Rounds of alignment once all frames are in: all keyframes with each other, until they stay where they are.

A batch run and a live run do the same rounds. They differ in what moving a keyframe involves (a live run also
sweeps it and shows it), which a :class:`KeyframeMover` says, and in what they do between two steps.
"""

from collections.abc import Collection, Generator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.schedule import InferProgress, InferSteps, StopRequestedError
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.settling import OutcomeT, Settling
from taichi_mrf.methods.mrf.map import MRFMap

LOSS = 0.1
"""Log-likelihood per pixel that a round may cost if poses were recorded. Keyframes that were aligned one
after the other fit each other a little better than all together, where recorded poses count too; if they do
not fit, more is lost by far. Of a tracked camera nothing may be lost."""

MOST_ROUNDS = 2
"""After that many rounds keyframes stay where they are."""

SETTLED = 0.02
"""Share of a voxel: rounds end when no keyframe was moved further."""


@dataclass(frozen=True)
class RoundStep:
    """A step of round ``round`` (from 1) of ``rounds``: of the ``keyframes``, ``moved`` stand at their new
    poses. ``judging``: the map is swept and the likelihood of the depth computed, before and after a
    round."""

    round: int
    rounds: int
    moved: int
    keyframes: int
    judging: bool = False


class KeyframeMover(Protocol):
    """Moves and sweeps keyframes during the rounds."""

    def move(self, id: int, T_world_camera: Pose) -> None:
        """Give a keyframe of the map another pose, (4, 4)."""
        ...

    def sweep(self) -> Generator[InferProgress, None, object]:
        """Sweep all keyframes once, from no messages, step by step."""
        ...


class PlainMover:
    """Moves keyframes of a map that is not shown."""

    def __init__(self, m: MRFMap) -> None:
        self._map = m

    def move(self, id: int, T_world_camera: Pose) -> None:
        """Move a keyframe; its messages begin anew."""
        if not np.array_equal(self._map.keyframes[id].T_world_camera, T_world_camera):
            self._map.move_keyframe(id, T_world_camera)

    def sweep(self) -> InferSteps:
        """See :class:`KeyframeMover`."""
        return self._map.infer_steps(sweeps=1)


class AlignmentRounds(Settling[RoundStep, bool]):
    """The rounds of one map. The outcome is False if they were stopped; the round under way is then undone.
    The marginals have to be inferred again afterwards."""

    def __init__(self, refiner: PoseRefiner, mover: KeyframeMover, fixed: Collection[int] = ()) -> None:
        """Align all keyframes with each other and with where they were recorded, but for the ``fixed`` ones
        (ids), until they stay where they are or MOST_ROUNDS are over. A round that makes
        their depth less likely is undone."""
        self._map, self._refiner, self._mover = refiner.map, refiner, mover
        self._step = RoundStep(0, MOST_ROUNDS, 0, len(refiner.map.keyframes))
        super().__init__(self._rounds(fixed))

    def _rounds(self, fixed: Collection[int]) -> Generator[RoundStep, None, bool]:
        stood: dict[int, Pose] = {}
        try:
            before = yield from self._log_likelihood()
            for round in range(1, MOST_ROUNDS + 1):
                stood = {id: keyframe.T_world_camera for id, keyframe in self._map.keyframes.items()}
                self._step = RoundStep(round, MOST_ROUNDS, 0, len(stood))
                found = yield from self._each(self._refiner.joint(fixed))
                for number, (id, T_world_camera) in enumerate(found.items(), start=1):
                    self._mover.move(id, T_world_camera)
                    self._step = RoundStep(round, MOST_ROUNDS, number, len(stood))
                    yield self._step
                if has_settled(self._map, stood):
                    break
                after = yield from self._log_likelihood()
                if is_worse(before, after, 0.0 if self._refiner.tracked else LOSS):
                    self._move_all(stood)
                    break
                before = after
        except StopRequestedError:
            self._move_all(stood)
            return False
        return True

    def _log_likelihood(self) -> Generator[RoundStep, None, float]:
        """Mean log-likelihood of the keyframes' depth, each in the map of the others, after one sweep over
        all."""
        self._step = replace(self._step, judging=True)
        yield from self._each(self._mover.sweep())
        return (yield from self._each(self._refiner.log_likelihood()))

    def _each(self, steps: Generator[object, None, OutcomeT]) -> Generator[RoundStep, None, OutcomeT]:
        """A RoundStep for each of some smaller steps; returns what came of them."""
        try:
            while True:
                next(steps)
                yield self._step
        except StopIteration as end:
            outcome: OutcomeT = end.value
            return outcome
        finally:
            steps.close()

    def _move_all(self, poses: Mapping[int, Pose]) -> None:
        for id, T_world_camera in poses.items():
            self._mover.move(id, T_world_camera)


def has_settled(m: MRFMap, stood: Mapping[int, Pose]) -> bool:
    """True if no keyframe has moved far from where it stood."""
    keyframes = m.keyframes
    moved_m = [tangent_norms(T, keyframes[id].T_world_camera)[1] for id, T in stood.items()]
    return max(moved_m, default=0.0) < SETTLED * m.voxel_size


def is_worse(before: float, after: float, loss: float) -> bool:
    """True if a round made the depth less likely by more than it may."""
    return not after > before - loss
