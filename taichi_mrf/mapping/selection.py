"""The frames that become keyframes: not the held-out ones, and only those taken far enough from others
(MRFMap, section V). And the keyframes to freeze when there are too many."""

import numpy as np

from taichi_mrf.config.schema import KeyframeConfig
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.methods.mrf.map import MRFMap


def is_held_out(number: int, hold_out: int) -> bool:
    """True if the ``number``-th frame (from 1) is held out: the middle one of each ``hold_out``, none with
    0."""
    return hold_out > 0 and (number - 1) % hold_out == hold_out // 2


class KeyframeSelector:
    """Selects a frame when the tangent norm of its rotation or of its translation is larger than a threshold.

    The norm is taken against the last keyframe, as in the paper. With both thresholds at 0 every frame is a
    keyframe; with one of them at 0 only the other counts. Of several sensors each has keyframes of its own,
    which alone its frames are compared with.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._last: dict[str, Pose] = {}  # of each sensor, T_world_camera of its last keyframe

    def wants(self, T_world_camera: Pose, sensor: str = "") -> bool:
        """True if a frame of a sensor with this pose, (4, 4), should become a keyframe. Does not change the
        selector."""
        if self._config.rotation == 0 and self._config.translation == 0:
            return True
        return sensor not in self._last or self._is_far(self._last[sensor], T_world_camera)

    def objection(self, T_world_camera: Pose, measured: bool, sensor: str = "") -> str | None:
        """The reason why a frame with this pose, (4, 4), is no keyframe; None if it is. ``measured``: its
        image holds a measurement, or a missing one that counts (Frame.tells_anything)."""
        if not self.wants(T_world_camera, sensor):
            return "too near to a keyframe"
        return None if measured else "no pixel holds a measurement"

    def accept(self, T_world_camera: Pose, sensor: str = "") -> None:
        """Note the pose of a frame that has become a keyframe."""
        self._last[sensor] = T_world_camera

    def _is_far(self, T_world_keyframe: Pose, T_world_camera: Pose) -> bool:
        rotation, translation = tangent_norms(T_world_keyframe, T_world_camera)
        turned = self._config.rotation > 0 and rotation > self._config.rotation
        moved = self._config.translation > 0 and translation > self._config.translation
        return turned or moved


def surplus(m: MRFMap, newest: int, keep: int) -> list[int]:
    """The keyframes (ids) beyond ``keep`` to freeze, so that an endless run is bounded in time and memory.

    First those that share least of what they see with keyframe ``newest``, because they will not change soon;
    of equal ones the oldest. If evidence has a date, the oldest: others would wait. Never ``newest``.
    """
    others = [k for id, k in m.keyframes.items() if id != newest and k.messages is not None]
    number = max(0, len(m.keyframes) - max(1, keep))
    in_view = np.zeros(m.view.pool.capacity, bool)
    if m.view.pool.dated is None:
        in_view[m.keyframes[newest].visible.slots] = True
    shared = {k.id: float(in_view[k.visible.slots].mean()) if len(k.visible.slots) else 0.0 for k in others}
    return sorted(shared, key=lambda id: (shared[id], m.keyframes[id].stamp_s, id))[:number]
