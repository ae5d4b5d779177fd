"""Result of a run of mapping: batch and live runs fill in the same record."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from taichi_mrf.mapping.follow import Followed
from taichi_mrf.mapping.refinement import PoseChange
from taichi_mrf.mapping.step_check import StepCheck, check_steps
from taichi_mrf.mapping.tracking import Track
from taichi_mrf.methods.protocol import OccupancyMap


@dataclass
class MappingResult:
    """The map of a run and how it came about.

    ``frames`` counts the frames that were looked at. ``skipped`` has the problem of each unreadable or lost
    frame by name, ``held_out`` the dataset indices of the frames that check the map, ``seconds`` the time of
    each stage. ``interrupted``: the run was stopped before its end; the map holds everything up to there.
    ``poses`` are, if they were refined, the recorded and the refined pose of every keyframe; ``track`` has,
    if poses were tracked, the pose of each frame, and ``loops_closed`` counts the loops. ``full`` names the
    frame that did not fit into memory and says why; the map holds those before it. ``steps``: whether depth
    and recorded poses agree, if that was checked. ``followed``: what became of poses that changed, if there
    were any to follow. ``before`` counts the keyframes of earlier recordings that the map began with, and
    ``doubt`` says why the recording may not be where it was located among them.
    """

    map: OccupancyMap
    frames: int = 0
    held_out: list[int] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    sweeps: int = 0
    residual: float | None = None
    interrupted: bool = False
    poses: list[PoseChange] = field(default_factory=list)
    track: Track | None = None
    loops_closed: int = 0
    full: str | None = None
    steps: StepCheck | None = None
    followed: Followed | None = None
    before: int = 0
    doubt: str = ""

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def check_steps(self) -> None:
        """Compare the recorded steps of the camera with those found by aligning depth, unless poses were
        tracked."""
        if self.track is not None:
            return
        keyframes = self.map.keyframes
        T_recorded = {id: keyframe.T_world_camera for id, keyframe in keyframes.items()}
        T_recorded |= {change.keyframe: change.T_recorded for change in self.poses}
        self.steps = check_steps(keyframes, T_recorded, self.map.noise, self.map.sensor.max_depth)
