"""Which keyframes to freeze, so that an endless run is bounded in time and memory.

A keyframe that shares no space with the newest one will not change soon: its messages become part of the
evidence that inference starts from, and its image and messages are dropped.
"""

import numpy as np

from taichi_mrf.methods.capabilities import FreezingMap


def surplus(m: FreezingMap, newest: int, keep: int) -> list[int]:
    """The keyframes (ids) beyond ``keep`` that should be frozen, in that order: those first that share the
    smallest part of what they see with keyframe ``newest``, of equal ones the oldest. Never ``newest``."""
    others = [k for id, k in m.keyframes.items() if id != newest and k.messages is not None]
    number = max(0, len(m.keyframes) - max(1, keep))
    in_view = np.zeros(m.view.pool.capacity, bool)
    in_view[m.keyframes[newest].visible.slots] = True
    shared = {k.id: float(in_view[k.visible.slots].mean()) if len(k.visible.slots) else 0.0 for k in others}
    return sorted(shared, key=lambda id: (shared[id], id))[:number]
