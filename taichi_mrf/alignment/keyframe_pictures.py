"""The colours that the keyframes of one map have seen, for the alignment of further frames.

Of each keyframe a few hundred points are kept, in its own frame, so that they follow when it is moved. A
frame is aligned with those of the keyframes that were taken nearest to it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_mrf.alignment.contrast import ContrastImage, TexturedPoints, contrast_images
from taichi_mrf.alignment.photometric import Photometric
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.sensor.frame import Frame

COMPARED = 4
"""Keyframes that a frame is compared with."""

LARGEST_TURN, LARGEST_SHIFT_M = 0.6, 1.0
"""Radians and metres from a guess, up to which a keyframe shows the same."""


@dataclass(frozen=True)
class ColorLevel:
    """A frame's contrast, and the points of the world that it is compared with, at one width."""

    image: ContrastImage
    points: TexturedPoints

    def seen_from(self, T_world_camera: Pose) -> Photometric | None:
        """The residuals of the points that the image shows if it was taken at a pose."""
        return Photometric.seen_from(self.image, self.points, T_world_camera)


class KeyframePictures:
    """Textured points by keyframe, coarse and fine. Those of keyframes that are gone or frozen are
    dropped."""

    def __init__(self) -> None:
        self._kept: dict[int, list[TexturedPoints]] = {}

    def keep(self, keyframe: int, frame: Frame) -> None:
        """Keep what a frame that has become a keyframe shows."""
        points = [image.textured_points() for image in contrast_images(frame)]
        if points and len(points[-1].points):
            self._kept[keyframe] = points

    def compared_with(
        self, frame: Frame, keyframes: Mapping[int, Keyframe], T_world_camera: Pose
    ) -> list[ColorLevel]:
        """The frame beside the keyframes that were taken nearest to a pose, coarse and fine; empty if there
        are none, or nothing on them has a texture."""
        self._kept = {id: points for id, points in self._kept.items() if id in keyframes}
        near = self._nearest(T_world_camera, keyframes)
        images = contrast_images(frame) if near else []
        return [ColorLevel(image, self._of(near, level, keyframes)) for level, image in enumerate(images)]

    def _nearest(self, T_world_camera: Pose, keyframes: Mapping[int, Keyframe]) -> Sequence[int]:
        ids = list(self._kept)
        if not ids:
            return []
        poses = np.stack([keyframes[id].T_world_camera for id in ids])
        shift_m = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], T_world_camera[:3, :3]) - 1) / 2
        turn = np.arccos(np.clip(cosine, -1, 1))
        apart = turn / LARGEST_TURN + shift_m / LARGEST_SHIFT_M
        order = np.argsort(apart, kind="stable")[:COMPARED]
        return [ids[i] for i in order if turn[i] < LARGEST_TURN and shift_m[i] < LARGEST_SHIFT_M]

    def _of(self, ids: Sequence[int], level: int, keyframes: Mapping[int, Keyframe]) -> TexturedPoints:
        """The points of some keyframes in the world."""
        world, contrast = [], []
        for id in ids:
            points, T = self._kept[id][level], keyframes[id].T_world_camera
            world.append(points.points @ T[:3, :3].T + T[:3, 3])
            contrast.append(points.contrast)
        return TexturedPoints(np.concatenate(world).astype(np.float32), np.concatenate(contrast))
