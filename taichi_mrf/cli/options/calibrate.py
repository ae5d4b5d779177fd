"""``taichi-mrf calibrate``: learn a depth camera's bias and sigma from depth whose true value is known."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.cli.options.shared import Verbosity
from taichi_mrf.errors import ConfigError


@dataclass(frozen=True)
class Calibrate:
    """Learn a depth camera's bias and sigma for each patch of pixels.

    The true depth comes from --true-depth, or from a chessboard in --images, or from the motion capture of
    camera and board in --camera-poses and --board-poses (with --images). docs/calibration.md explains how
    to record. Example: taichi-mrf calibrate depth/ --true-depth true/ --out sensor/
    """

    depth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DEPTH")]
    """A folder of measured depth (16-bit PNG, .npy, .npz stacks), or one stack."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder for the results; created if needed."""

    true_depth: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """True depth images of the same names as the measured ones, or one stack."""

    images: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Images of a chessboard, of the same names as the depth: infrared of the same camera, or colour
    registered to it."""

    camera_poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Motion capture of the camera: lines of stamp tx ty tz qx qy qz qw. A single line stands for a camera on
    a tripod."""

    board_poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Motion capture of the board, in the same world."""

    stamps: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Lines of stamp and file name for the depth images; by default the file names are stamps in seconds."""

    camera: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="WIDTH HEIGHT FX FY CX CY"),
    ] = None
    """Intrinsics of the depth camera in pixels; by default read from a camera.txt beside the depth."""

    depth_scale: float = 1000.0
    """Integer steps per metre in the measured depth."""

    true_depth_scale: float | None = None
    """Steps per metre in the true depth, if different."""

    no_returns: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also learn the probability of no return (``sensor.no_return: model``), from pixels that have a true
    depth and no measured one. Needs --true-depth."""

    pictures: bool = True
    """Draw bias and sigma against depth and over the image, and the coverage."""

    printing: Annotated[Verbosity, tyro.conf.arg(name="")] = field(default_factory=Verbosity)
    """Amount of output."""

    settings: Annotated[CalibrationConfig, tyro.conf.arg(name="")] = field(default_factory=CalibrationConfig)
    """Parameters."""

    def __post_init__(self) -> None:
        if (self.camera_poses is None) != (self.board_poses is None):
            raise ConfigError("--camera-poses and --board-poses go together")
        if self.no_returns and self.true_depth is None:
            raise ConfigError("--no-returns needs --true-depth: a board hides what is behind it")
        if (self.true_depth is None) == (self.images is None):
            raise ConfigError("give one source of true depth: --true-depth, or --images of a chessboard")
        if self.camera_poses is not None and self.images is None:
            raise ConfigError("--camera-poses needs the chessboard's --images, which give the time lag")
