"""The frames on which parameters are tuned: training, held-out and unseen.

Training frames make the map, and held-out frames score it. Unseen frames, which an automatic search keeps
back, show at the end whether its result holds for views that were not used for tuning. Where
the scene is rendered, the true occupancy of its voxels is known too.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh
from taichi_mrf.errors import ConfigError, DatasetError, FrameError
from taichi_mrf.evaluation.occupancy_scores import reliability_bins
from taichi_mrf.evaluation.occupancy_truth import OccupancyTruth, occupancy_truth
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.mapping.selection import is_held_out
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import Camera, PinholeCamera, pinhole
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.viewer.tune.messages import FrameChoice

LARGEST_STRIDE = 10
"""Frames that are further apart in a recording may not see each other's surfaces any more."""

FIRST_LOOK_COLUMNS = 160

MOST_VOXELS = 2_000_000
"""Most voxels that are compared; of more, every second, third, ... one is."""

_KEPT_SIZES = 4
"""Voxel sizes whose truth is kept in memory."""


class VoxelTruth:
    """The true occupancy of the voxels in some noiseless views, at any voxel size."""

    def __init__(
        self,
        mesh: TriangleMesh,
        clean_depths_m: Sequence[NDArray[np.float32]],
        poses: Sequence[Pose],
        camera: PinholeCamera,
    ) -> None:
        """The arguments are those of evaluation.occupancy_truth.occupancy_truth."""
        self._scene = (mesh, tuple(clean_depths_m), tuple(poses), camera)
        self._known: dict[float, OccupancyTruth] = {}

    def calibration_error(self, m: OccupancyMap) -> float:
        """Expected calibration error of a map's marginals over the voxels whose truth is known."""
        probability: list[NDArray[np.float32]] = []
        occupied: list[NDArray[np.bool_]] = []
        known = self._at(m.voxel_size)
        step = -(-sum(known.counts) // MOST_VOXELS)
        for centres, truth in known.blocks():
            probability.append(m.marginals.occupancy(centres[::step]))
            occupied.append(truth[::step])
        if not probability:
            return float("nan")
        return reliability_bins(np.concatenate(probability), np.concatenate(occupied)).calibration_error

    def _at(self, voxel_size: float) -> OccupancyTruth:
        if voxel_size not in self._known:
            if len(self._known) == _KEPT_SIZES:
                del self._known[next(iter(self._known))]
            self._known[voxel_size] = occupancy_truth(*self._scene, voxel_size)
        return self._known[voxel_size]


@dataclass(frozen=True)
class WorkingSet:
    """Frames in memory. ``choice`` is the request, with the stride that was chosen; ``skipped`` has the
    error of each unreadable frame; ``truth`` is the true occupancy, if the scene is known."""

    source: str
    camera: Camera
    choice: FrameChoice
    training: tuple[Frame, ...]
    held_out: tuple[Frame, ...]
    unseen: tuple[Frame, ...] = ()
    skipped: tuple[str, ...] = ()
    truth: VoxelTruth | None = None


def read_working_set(dataset: Dataset, choice: FrameChoice, keep_unseen: bool = False) -> WorkingSet:
    """Read the chosen frames; with ``keep_unseen`` every second held-out frame is kept back.

    A broken frame is left out. Raises DatasetError for a source that never ends and one without frames to
    train on and to hold out, ConfigError for a choice that lies outside the sequence.
    """
    indices, scored = split_indices(dataset, choice)
    choice = _settled(choice, len(dataset))
    roles: dict[str, list[tuple[int, Frame]]] = {"training": [], "held_out": [], "unseen": []}
    skipped = []
    for index in indices:
        role = "training"
        if index in scored:
            role = "unseen" if keep_unseen and scored.index(index) % 2 else "held_out"
        try:
            frame = dataset.read(index)
        except FrameError as error:
            skipped.append(str(error))
            continue
        if (frame.depth_m > 0).any():
            roles[role].append((index, frame))
    for role, wanted in (("training", True), ("held_out", True), ("unseen", keep_unseen)):
        if wanted and not roles[role]:
            found = f"; the first that is broken: {skipped[0]}" if skipped else ""
            raise DatasetError(
                f"{dataset.name}: no {role.replace('_', '-')} frame among the {len(indices)} chosen{found}"
            )
    frames = {role: tuple(frame for _, frame in found) for role, found in roles.items()}
    truth = truth_of(dataset, [index for index, _ in roles["training"]])
    return WorkingSet(dataset.name, dataset.camera, choice, **frames, skipped=tuple(skipped), truth=truth)


def split_indices(dataset: Dataset, choice: FrameChoice) -> tuple[list[int], list[int]]:
    """The chosen frames of a dataset, by index, and of these the ones that do not make the map, held out or
    kept back. Raises DatasetError for a source that never ends, ConfigError for a choice that lies outside
    the sequence."""
    if dataset.endless:
        raise DatasetError(
            f"{dataset.name}: parameters are tuned on frames that can be read again: record it"
        )
    choice = _settled(choice, len(dataset))
    indices = range(choice.first, len(dataset), choice.stride)[: choice.count]
    return list(indices), [i for n, i in enumerate(indices, start=1) if is_held_out(n, choice.hold_out)]


def coarse_stride(camera: Camera) -> int:
    """The pixel stride of a first look: about 160 columns. Rays without a pattern have no columns, and all of
    them are looked at."""
    return max(1, camera.width // FIRST_LOOK_COLUMNS) if camera.pixels_per_radian > 0 else 1


def thinned(frame: Frame, pixel_stride: int) -> Frame:
    """The frame with every ``pixel_stride``-th pixel along both sides; the others measure nothing.

    The camera stays as it is, and so does the patch of a noise table that a pixel belongs to.
    """
    if pixel_stride == 1:
        return frame
    kept = np.zeros_like(frame.depth_m)
    some = np.s_[pixel_stride // 2 :: pixel_stride, pixel_stride // 2 :: pixel_stride]
    kept[some] = frame.depth_m[some]
    # A frame of a few pixels only may have measured something between those.
    return dataclasses.replace(frame, depth_m=kept) if (kept > 0).any() else frame


def _settled(choice: FrameChoice, frames: int) -> FrameChoice:
    """The choice with its stride filled in: by default frames are spread evenly, but not too far apart."""
    if not 0 <= choice.first < frames:
        raise ConfigError(f"the first frame must lie between 0 and {frames - 1}, not {choice.first}")
    if choice.stride > 0:
        return choice
    spread = max(1, min(LARGEST_STRIDE, (frames - choice.first) // choice.count))
    return dataclasses.replace(choice, stride=spread)


def truth_of(dataset: Dataset, indices: Sequence[int]) -> VoxelTruth | None:
    """The true occupancy of the voxels that some frames of a dataset see; None for a real recording and for a
    scene in which something moves."""
    mesh = _mesh_of(dataset)
    if mesh is None:
        return None
    source = dataset  # SyntheticRoom or MeshSequence, which alone have what follows
    depths = [source.clean_depth(index) for index in indices]  # type: ignore[attr-defined]
    poses = [source.pose(index) for index in indices]
    return VoxelTruth(mesh, depths, poses, pinhole(dataset.camera, "the truth of a rendered scene"))


def _mesh_of(dataset: Dataset) -> TriangleMesh | None:
    # Imported late: most sequences are recorded, and have nothing of the kind.
    from taichi_mrf.datasets.synthetic.mesh_scene import MeshSequence, scene_mesh
    from taichi_mrf.datasets.synthetic.room import SyntheticRoom

    if isinstance(dataset, SyntheticRoom):
        return scene_mesh(dataset.scene) if dataset.moving_scene is None else None
    return dataset.scene.mesh if isinstance(dataset, MeshSequence) else None
