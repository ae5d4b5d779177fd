"""Rounds of alignment once all frames are in: all keyframes with each other, until they stay where they are.

A batch run and a live run do the same rounds. They differ in what moving a keyframe involves (a live run also
sweeps it and shows it), which a :class:`KeyframeMover` says, and in what happens between two steps: a batch
run tells of its progress, a live run carries out the requests that have come.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.schedule import InferProgress, Progress
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.methods.capabilities import AligningMap

LOSS = 0.1
"""Log-likelihood per pixel that a round may cost. Keyframes that were aligned one after the other fit each
other a little better than all together, where recorded poses count too; if they do not fit, more is lost by
far."""

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


GoOn = Callable[[RoundStep], bool]
"""Called after each step; returns whether to go on."""


class KeyframeMover(Protocol):
    """How keyframes are moved and swept during the rounds."""

    def move(self, id: int, T_world_camera: Pose) -> None:
        """Give a keyframe of the map another pose, (4, 4)."""
        ...

    def sweep(self, progress: Progress) -> None:
        """Sweep all keyframes once; ``progress`` returns False to stop."""
        ...


class PlainMover:
    """Moves keyframes of a map that is not shown."""

    def __init__(self, m: AligningMap) -> None:
        self._map = m

    def move(self, id: int, T_world_camera: Pose) -> None:
        """Move a keyframe; its messages begin anew."""
        if not np.array_equal(self._map.keyframes[id].T_world_camera, T_world_camera):
            self._map.move_keyframe(id, T_world_camera)

    def sweep(self, progress: Progress) -> None:
        """Sweep all keyframes once, from no messages."""
        self._map.infer(sweeps=1, progress=progress)


class _AbandonedError(Exception):
    """``go_on`` has returned False."""


class AlignmentRounds:
    """The rounds of one map."""

    def __init__(self, refiner: PoseRefiner, mover: KeyframeMover, go_on: GoOn) -> None:
        self._map, self._refiner, self._mover, self._go_on = refiner.map, refiner, mover, go_on
        self._step = RoundStep(0, refiner.config.rounds, 0, len(refiner.map.keyframes))

    def run(self, fixed: Collection[int] = ()) -> bool:
        """Align all keyframes with each other and with where they were recorded, but for the ``fixed`` ones
        (ids), until they stay where they are or the configuration's rounds are over. A round that makes
        their depth less likely is undone.

        Returns False if ``go_on`` ended the rounds; the one under way is then undone. The marginals have to
        be inferred again afterwards.
        """
        stood: dict[int, Pose] = {}
        rounds = self._refiner.config.rounds
        try:
            before = self._log_likelihood() if rounds else 0.0
            for round in range(1, rounds + 1):
                stood = {id: keyframe.T_world_camera for id, keyframe in self._map.keyframes.items()}
                self._step = RoundStep(round, rounds, 0, len(stood))
                found = self._refiner.joint(fixed, self._ask)
                for number, (id, T_world_camera) in enumerate(found.items(), start=1):
                    self._mover.move(id, T_world_camera)
                    self._step = RoundStep(round, rounds, number, len(stood))
                    self._ask()
                if has_settled(self._map, stood):
                    break
                after = self._log_likelihood()
                if is_worse(before, after):
                    self._move_all(stood)
                    break
                before = after
        except _AbandonedError:
            self._move_all(stood)
            return False
        return True

    def _log_likelihood(self) -> float:
        """Mean log-likelihood of the keyframes' depth, each in the map of the others, after one sweep over
        all."""
        self._step = replace(self._step, judging=True)
        wanted = True

        def progress(step: InferProgress) -> bool:
            nonlocal wanted
            wanted = self._go_on(self._step)
            return wanted

        self._mover.sweep(progress)
        if not wanted:
            raise _AbandonedError
        return self._refiner.log_likelihood(self._ask)

    def _ask(self) -> None:
        if not self._go_on(self._step):
            raise _AbandonedError

    def _move_all(self, poses: Mapping[int, Pose]) -> None:
        for id, T_world_camera in poses.items():
            self._mover.move(id, T_world_camera)


def has_settled(m: AligningMap, stood: Mapping[int, Pose]) -> bool:
    """Whether no keyframe has moved far from where it stood."""
    keyframes = m.keyframes
    moved_m = [tangent_norms(T, keyframes[id].T_world_camera)[1] for id, T in stood.items()]
    return max(moved_m, default=0.0) < SETTLED * m.voxel_size


def is_worse(before: float, after: float) -> bool:
    """Whether a round made the depth less likely by more than it may."""
    return not after > before - LOSS
