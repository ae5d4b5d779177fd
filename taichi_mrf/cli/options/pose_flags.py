"""Flags of map and live for the use of recorded poses."""

from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from taichi_mrf.config.schema import Config


@dataclass(frozen=True)
class PoseFlags:
    """How far recorded poses are trusted: a little less, or not at all."""

    refine_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Align each new keyframe with those before it, and all with each other at the end; the same as
    --poses.refine."""

    track_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Find the pose of each frame by aligning it with the map so far; SOURCE's own poses, if any, are
    ignored except for the first. realsense:?poses=track does the same."""

    def parameters(self, settings: Config) -> Config:
        """The parameters with these flags applied."""
        return (
            replace(settings, poses=replace(settings.poses, refine=True)) if self.refine_poses else settings
        )
