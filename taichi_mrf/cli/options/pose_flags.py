"""Flags of map and live for the use of recorded poses."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import tyro

from taichi_mrf.config.schema import Config
from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class PoseFlags:
    """How far recorded poses are trusted, or what takes their place."""

    refine_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Align each new keyframe with those before it, and all with each other at the end; the same as
    poses.refine in a file."""

    track_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Find the pose of each frame by aligning it with the map so far; SOURCE's own poses, if any, are
    ignored except for the first. realsense: does so unless it is given poses."""

    file: Annotated[str | None, tyro.conf.arg(name="poses", metavar="FILE")] = None
    """Poses of SOURCE's frames, in place of its own: a trajectory (TUM, KITTI, .log), a pose graph (g2o,
    TORO), a database of RTAB-Map, or a bag (walk.bag?pose=/PATH). Frames that it does not name keep their
    own."""

    follow: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The file of --poses changes while SOURCE is mapped: keyframes follow it. map ends when the recording is
    over and the file has been unchanged for 10 s."""

    def __post_init__(self) -> None:
        if self.follow and self.file is None:
            raise ConfigError("--follow needs the file that is followed: --poses FILE")
        if self.file is not None and self.track_poses:
            raise ConfigError("--poses and --track-poses both say where the poses come from: choose one")
        if self.follow and self.refine_poses:
            raise ConfigError("--follow and --refine-poses both move keyframes: choose one")

    def choice(self) -> dict[str, Any]:
        """Which poses are used, for the report; what is None was not asked for."""
        return {
            "track_poses": self.track_poses,
            "poses_from": self.file,
            "follow": self.follow or None,
        }

    def parameters(self, settings: Config) -> Config:
        """The parameters with these flags applied."""
        return (
            replace(settings, poses=replace(settings.poses, refine=True)) if self.refine_poses else settings
        )
