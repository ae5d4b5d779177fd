"""Flags and checks that the options of several commands share."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import ConfigError

Reading = Annotated[SourceFlags, tyro.conf.arg(name=""), tyro.conf.UseAppendAction]
"""A command's options for reading its source, as a field."""


def check_least(options: object, **least: int) -> None:
    """Raise ConfigError, which names the flag, if a field of the options is a number below its least."""
    for name, lowest in least.items():
        value = getattr(options, name)
        if isinstance(value, int) and value < lowest:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least {lowest}, not {value}")


def check_port(port: int) -> None:
    """Raise ConfigError unless a page can be served at this port."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port must lie between 0 and 65535, not {port}")


@dataclass(frozen=True)
class Verbosity:
    """Amount of output."""

    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print only problems, and JSON if requested."""

    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print every step instead of a progress bar, and which backend was chosen and why."""

    def __post_init__(self) -> None:
        if self.quiet and self.verbose:
            raise ConfigError("--quiet and --verbose cannot be combined")


@dataclass(frozen=True)
class NoiseFlags:
    """Source of sigma."""

    origin: Annotated[Literal["checked", "given", "auto"], tyro.conf.arg(name="noise")] = "checked"
    """given: sigma from the parameters. auto: learnt first, from up to 60 frames, and saved in
    DIR/sensor.yaml for other recordings. checked: given, but map learns it if 8 to 16 frames contradict the
    default or a stated sigma is three times too small."""

    @property
    def is_learnt(self) -> bool:
        """True if sigma is to be learnt."""
        return self.origin == "auto"

    @property
    def is_checked(self) -> bool:
        """True if sigma is to be learnt where held-out frames contradict the default."""
        return self.origin == "checked"

    def refuse_with(self, **flags: object) -> None:
        """Raises ConfigError if sigma is to be learnt and one of these flags is set."""
        clashing = [f"--{name.replace('_', '-')}" for name, value in flags.items() if value]
        if self.is_learnt and clashing:
            raise ConfigError(
                f"--noise auto does not work with {' or '.join(clashing)}: learn the noise in a run without, "
                "and pass its sensor.yaml with --config"
            )


@dataclass(frozen=True)
class PoseFlags:
    """Trust in recorded poses, or their replacement."""

    refine_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Align each new keyframe with the earlier ones, and all with each other at the end; the same as
    poses.refine in a file."""

    track_poses: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Find the pose of each frame by aligning it with the map so far; SOURCE's own poses, if any, are ignored
    except for the first. For realsense: this is the default, unless poses are given."""

    file: Annotated[str | None, tyro.conf.arg(name="poses", metavar="FILE")] = None
    """Poses of SOURCE's frames, in place of its own: a trajectory (TUM, KITTI, .log), a pose graph (g2o,
    TORO), a database of RTAB-Map, or a bag (walk.bag?pose=/PATH). Frames without a pose in FILE keep their
    own."""

    follow: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Move keyframes whenever the file of --poses changes during mapping. After the recording, map ends once
    the file has been unchanged for 10 s."""

    def __post_init__(self) -> None:
        if self.follow and self.file is None:
            raise ConfigError("--follow needs the file to follow: add --poses FILE")
        if self.file is not None and self.track_poses:
            raise ConfigError("--poses and --track-poses both say where the poses come from: choose one")
        if self.follow and self.refine_poses:
            raise ConfigError("--follow and --refine-poses both move keyframes: choose one")

    def choice(self) -> dict[str, Any]:
        """Sources of poses for the report; None if not requested."""
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


def check_onto(onto: Path | None, frozen: bool, poses: PoseFlags) -> None:
    """Raise ConfigError for flags that do not go with ``--onto``, or without it."""
    if frozen and onto is None:
        raise ConfigError("--frozen is for the keyframes of an earlier map: add --onto MAP")
    if onto is not None and (poses.refine_poses or poses.follow):
        flag = "--refine-poses" if poses.refine_poses else "--follow"
        raise ConfigError(f"{flag} moves keyframes, and does not work with --onto")
