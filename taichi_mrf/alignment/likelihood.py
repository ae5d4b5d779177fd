"""How likely a keyframe's depth is in the map of all others, from where it stands or from elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import withdraw_messages
from taichi_mrf.queries.view import View
from taichi_mrf.system import runtime

STRIDE = 4
"""One pixel in so many, along both axes, is compared."""

OUTLIERS = 0.01
"""Share of the measurements that may come from anywhere in the sensor's range."""


@contextmanager
def map_of_others(view: View, keyframe: Keyframe) -> Iterator[None]:
    """Let the view see, while the block runs, what all but one keyframe believe (eq. 6).

    The messages of ``keyframe``, if it has any, must fit its visible bricks, and those be up to date.
    """
    cavity = view.pool.snapshot(undated=True)
    if keyframe.messages is not None:
        withdraw_messages(keyframe.visible, keyframe.messages, cavity.belief)
    with view.pool.showing(cavity):
        yield
    runtime.settle()  # before the snapshot is dropped


def log_likelihood(view: View, keyframe: Keyframe, T_world_camera: Pose, max_depth: float) -> float:
    """Mean log density, per metre, of every STRIDE-th pixel's depth, measured from a pose."""
    measured = np.zeros(keyframe.camera.shape, np.float32)
    # Rays without a pattern are rows of their own.
    rows, columns = (slice(STRIDE // 2, None, STRIDE) if n > STRIDE else slice(None) for n in measured.shape)
    measured[rows, columns] = keyframe.depth_m[rows, columns]
    asked = measured > 0
    if not asked.any():
        return float("nan")
    noise = keyframe.image.at_certain_pose.noise_table  # the pose is given here
    survey = view.survey(keyframe.camera, T_world_camera, max_depth, measured, noise)
    anywhere = 1.0 / max_depth
    explained = survey.likelihood[asked] + anywhere * survey.visibility[asked].astype(np.float64)
    return float(np.mean(np.log((1.0 - OUTLIERS) * explained + OUTLIERS * anywhere)))
