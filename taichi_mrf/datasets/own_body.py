"""The robot's own body, as far as it is known: the sensor sees it, but it is no part of the world."""

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, TypeVar

from taichi_mrf.errors import ConfigError

Box = tuple[float, float, float, float, float, float]
"""x0 y0 z0 x1 y1 z1: two corners in metres, the lower one first."""

_FILE = {"metavar": "FILE"}

AnyBody = TypeVar("AnyBody", bound="OwnBody")


@dataclass(frozen=True, kw_only=True)
class OwnBody:
    """Extent of the robot itself. A pixel on it is neither a measurement of the world nor a missing one."""

    mask: str | None = field(default=None, metadata=_FILE)
    """A single-channel image (PNG) of the size of the stored depth images: 0 marks the robot's own body, any
    other value the world. A mask has no depth, so the space that it covers stays unknown."""

    body_box: tuple[Box, ...] = field(default=(), metadata={"metavar": "X0 Y0 Z0 X1 Y1 Z1"})
    """A box in the frame of the camera or lidar, in metres. Measurements in it belong to the robot's own
    body. The flag may be repeated."""

    robot: str | None = field(default=None, metadata=_FILE)
    """A URDF of the robot. Pixels that its geometry covers at the frame's stamp show the robot's own body;
    measurements in front of it stay."""

    camera_link: str | None = field(default=None, metadata={"metavar": "NAME"})
    """The link of the URDF whose frame is the camera's (x right, y down, z ahead) or lidar's."""

    joints: str | None = field(default=None, metadata=_FILE)
    """Positions of the URDF's joints, in radians or metres: a YAML file of 'name: value', or a .csv table
    with the columns stamp and one for each joint, interpolated linearly. Other joints are at 0."""

    body_margin: float = 0.02
    """Margin by which the URDF's geometry is grown (metres)."""

    body_space: Literal["free", "unknown"] = "free"
    """State of the space inside the URDF's geometry where pixels measure it (mrf only): free of anything
    else, or unknown."""

    def __post_init__(self) -> None:
        if (self.robot is None) != (self.camera_link is None) or (self.joints and self.robot is None):
            raise ConfigError("--robot needs --camera-link NAME, and --joints and --camera-link need --robot")
        if not 0 <= self.body_margin < math.inf:
            raise ConfigError(f"--body-margin must be a number of metres, not {self.body_margin:g}")
        for box in self.body_box:
            if not all(map(math.isfinite, box)) or not all(a < b for a, b in zip(box, box[3:], strict=False)):
                raise ConfigError(
                    "--body-box takes X0 Y0 Z0 X1 Y1 Z1 in metres, the first three below the last three, "
                    f"not {' '.join(f'{x:g}' for x in box)}"
                )

    @property
    def own_body(self) -> "OwnBody":
        """These fields alone."""
        return OwnBody(**{each.name: getattr(self, each.name) for each in fields(OwnBody)})

    def within(self: AnyBody, folder: Path) -> AnyBody:
        """Copy whose files are relative to a folder."""
        mask, robot, joints = (path and str(folder / path) for path in (self.mask, self.robot, self.joints))
        return replace(self, mask=mask, robot=robot, joints=joints)


NO_BODY = OwnBody()
"""Nothing is known of it."""
