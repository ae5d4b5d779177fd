"""Rounds of alignment when a live run's sequence has ended: all keyframes with each other, as map does.

Where they are to go is found without touching the map. Then one after the other is moved and swept, as if a
user had moved it, so that the map is whole between two of them and whoever watches sees it happen. A round
that makes the keyframes' depth less likely is taken back, and so is one that is abandoned.
"""

import time
from collections.abc import Callable, Mapping

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.schedule import InferProgress
from taichi_mrf.live.live_keyframes import Entry
from taichi_mrf.live.mapper import Mapper
from taichi_mrf.mapping.refinement import PoseRefiner
from taichi_mrf.mapping.rounds import has_settled, is_worse

GoOn = Callable[[str, float], bool]
"""Told what is being done and how much of that is; says whether to go on."""

ASK_SECONDS = 0.05
"""Whoever may end the rounds is asked so often, at most."""


class _AbandonedError(Exception):
    """Somebody wants something else first."""


class Rounds:
    """The rounds of one mapper, which refines poses."""

    def __init__(
        self, mapper: Mapper, refiner: PoseRefiner, go_on: GoOn, show: Callable[[Entry], None]
    ) -> None:
        """``show`` is called with each keyframe that was moved."""
        self._mapper, self._map, self._refiner = mapper, refiner.map, refiner
        self._go_on, self._show = go_on, show
        self._entries = {e.map_id: e for e in mapper.roster.with_state("on") if e.map_id is not None}
        self._doing, self._share, self._asked = "", 0.0, float("-inf")

    def run(self) -> bool:
        """Do all rounds; returns False if they were abandoned, and the last is taken back."""
        rounds = self._refiner.config.rounds
        stood: dict[int, Pose] = {}
        try:
            before = self._log_likelihood() if rounds else 0.0
            for round in range(1, rounds + 1):
                stood = {id: entry.T_world_camera for id, entry in self._entries.items()}
                self._begin(f"aligning all keyframes: round {round} of {rounds}", (round - 1) / rounds)
                fixed = [id for id, entry in self._entries.items() if entry.moved_by_hand]
                self._move_all(self._refiner.joint(fixed, self._ask))
                if has_settled(self._map, stood):
                    break
                after = self._log_likelihood()
                if is_worse(before, after):
                    self._move_all(stood, ask=False)
                    break
                before = after
        except _AbandonedError:
            self._move_all(stood, ask=False)
            return False
        return True

    def _move_all(self, poses: Mapping[int, Pose], ask: bool = True) -> None:
        for id, T_world_camera in poses.items():
            if ask:
                self._ask()
            entry = self._entries[id]
            if self._mapper.align(entry, T_world_camera):
                self._show(entry)

    def _log_likelihood(self) -> float:
        """Of the keyframes' depth, each in the map of the others, after one sweep over all of them."""
        self._begin("sweeping aligned keyframes", self._share)
        stopped = not self._map.infer(
            sweeps=1, keyframes=list(self._entries), progress=self._ask_sweeping
        ).complete
        if stopped:
            raise _AbandonedError
        return self._refiner.log_likelihood(self._ask)

    def _begin(self, doing: str, share: float) -> None:
        self._doing, self._share = doing, share

    def _ask_sweeping(self, step: InferProgress) -> bool:
        return self._go_on(self._doing, self._share)

    def _ask(self) -> None:
        now = time.monotonic()
        if now - self._asked >= ASK_SECONDS:
            self._asked = now
            if not self._go_on(self._doing, self._share):
                raise _AbandonedError
