"""wavemap's measurement model: what one beam says of a point in space (Reijgwart et al., RSS 2023).

A beam measured the range z in some direction; its range has the standard deviation range_sigma, its direction
angle_sigma. For a point at the distance d from the sensor and the angle a off the beam, with f = (d - z) /
range_sigma, g = a / angle_sigma and C the cumulative distribution of an approximate Gaussian,

    r = C(f) - C(f - 3) / 2 - 1/2      -1/2 in free space, above 0 behind the surface, 0 from f = 6 on
    w = C(g + 3) - C(g - 3)            1 on the axis, 0 from g = 6 on
    p = 1/2 + s r w                    s is scaling_free if r < 0, else scaling_occupied
"""

from dataclasses import dataclass

from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32


@ti.func
def cumulative(t: F32) -> F32:
    """C(t): the distribution of the sum of three numbers drawn evenly from -1 to 1. Its variance is 1, and
    nothing lies beyond 3."""
    low, high = ti.max(0.0, 3.0 + t), ti.max(0.0, 3.0 - t)
    value = 0.5 + t * low * high / 24.0
    if t > 1.0:
        value = 1.0 - high * high * high / 48.0
    elif t < -1.0:
        value = low * low * low / 48.0
    return value


@dataclass(frozen=True)
class BeamModel(Bundle):
    """The model with its parameters (WavemapConfig)."""

    range_sigma: F32
    """Metres."""

    angle_sigma: F32
    """Radians."""

    scaling_free: F32
    scaling_occupied: F32

    whole: I32
    """True if w is 1 for every beam."""

    @ti.func
    def log_odds(self, distance: F32, measured: F32, angle: F32) -> F32:
        """Change of a point's log-odds by a beam that measured a range."""
        f = (distance - measured) / self.range_sigma
        r = -0.5
        if f > -3.0:  # most voxels lie far in front of the surface
            r = cumulative(f) - 0.5 * cumulative(f - 3.0) - 0.5
        w = 1.0
        if self.whole == 0:
            w = 1.0 - cumulative(angle / self.angle_sigma - 3.0)  # g >= 0, so that C(g + 3) is 1
        scaled = r * w * (self.scaling_free if r < 0.0 else self.scaling_occupied)
        return ti.log((0.5 + scaled) / (0.5 - scaled))
