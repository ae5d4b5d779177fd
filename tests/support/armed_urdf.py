"""The robot of armed_room.py as a URDF: a camera in its housing, and a bar on a hinge."""

from pathlib import Path

from armed_room import ELBOW_M, HALF_M

TEXT = """<robot name="arm">
  <link name="base"/>
  <link name="housing"><visual><geometry><box size="0.1 0.05 0.06"/></geometry></visual></link>
  <joint name="mount" type="fixed"><parent link="base"/><child link="housing"/><origin xyz="0 0 0.5"/></joint>
  <link name="optical"/>
  <joint name="optics" type="fixed"><parent link="housing"/><child link="optical"/>
    <origin xyz="0.01 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
  <link name="bar"><visual><origin xyz="0 0 {back}"/><geometry>{bar}</geometry></visual></link>
  <joint name="elbow" type="revolute"><parent link="optical"/><child link="bar"/><origin xyz="{elbow}"/>
    <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>
"""


def write_urdf(path: Path, bar: str | None = None) -> Path:
    """The housing and the camera look along x, with z up; the bar is a box, or another geometry."""
    size = " ".join(f"{2 * half:g}" for half in HALF_M)
    elbow = " ".join(f"{x:g}" for x in ELBOW_M)
    path.write_text(TEXT.format(back=-HALF_M[2], bar=bar or f'<box size="{size}"/>', elbow=elbow))
    return path
