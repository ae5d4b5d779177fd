"""Which frames become keyframes: not the held-out ones, and only those taken far enough from other keyframes
(MRFMap, section V)."""

from taichi_mrf.config.schema import KeyframeConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms


def is_held_out(number: int, hold_out: int) -> bool:
    """Whether the ``number``-th frame (from 1) is held out: the middle one of each ``hold_out``, none with
    0."""
    return hold_out > 0 and (number - 1) % hold_out == hold_out // 2


class KeyframeSelector:
    """Selects a frame when the tangent norm of its rotation or of its translation is larger than a threshold.

    The norm is taken against the last keyframe, as in the paper, or against every earlier one, in which
    case a frame must be far from all of them. With both thresholds at 0 every frame is a keyframe; with
    one of them at 0 only the other counts.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._accepted: list[Pose] = []

    def wants(self, T_world_camera: Pose) -> bool:
        """Whether a frame with this pose, (4, 4), should become a keyframe. Does not change the selector."""
        if self._config.rotation == 0 and self._config.translation == 0:
            return True
        compared = self._accepted if self._config.against == "all" else self._accepted[-1:]
        return all(self._is_far(T_world_keyframe, T_world_camera) for T_world_keyframe in compared)

    def objection(self, T_world_camera: Pose, measured: bool) -> str | None:
        """Why a frame with this pose, (4, 4), does not become a keyframe; None if it does. ``measured``: its
        image holds a measurement."""
        if not self.wants(T_world_camera):
            return "too near to a keyframe"
        return None if measured else "no pixel holds a measurement"

    def accept(self, T_world_camera: Pose) -> None:
        """Note the pose of a frame that has become a keyframe."""
        self._accepted.append(T_world_camera)

    def _is_far(self, T_world_keyframe: Pose, T_world_camera: Pose) -> bool:
        rotation, translation = tangent_norms(T_world_keyframe, T_world_camera)
        turned = self._config.rotation > 0 and rotation > self._config.rotation
        moved = self._config.translation > 0 and translation > self._config.translation
        return turned or moved
