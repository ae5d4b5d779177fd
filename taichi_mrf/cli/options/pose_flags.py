"""The flags of map and live that say what is to become of the poses that frames were recorded with.

Nothing is imported here that would make the command line's help wait.
"""

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
    """Find the pose of each frame by aligning it with the map so far; SOURCE's own poses, if it has any, are
    not used but for the first. realsense:?poses=track says the same."""

    def parameters(self, settings: Config) -> Config:
        """The parameters with what these flags say."""
        return (
            replace(settings, poses=replace(settings.poses, refine=True)) if self.refine_poses else settings
        )
