"""The scenes of the comparison: which views are mapped and which judged, and what is known of the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from taichi_mrf import PolynomialNoise
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh, load_mesh, scene_mesh
from taichi_mrf.datasets.synthetic.room_furniture import room_scene as furnished_room
from taichi_mrf.evaluation.surface_scores import SurfaceTruth, surface_truth
from taichi_mrf.experiments.exact import room_scene
from taichi_mrf.experiments.folds import require_views
from taichi_mrf.experiments.peers.measuring import Case, keyframes
from taichi_mrf.experiments.peers.peer import thinned
from taichi_mrf.experiments.peers.truth import along_rays, of_geometry
from taichi_mrf.experiments.scenes import Scene, house_scene, kitchen_scene, lidar_scene, turned

VIEWS = 20
"""The first so many views of each scene, one after the other as a live run meets them."""

EVERY, FIRST = 5, 2
"""Every fifth view is held out, from the third on."""

SURFACE_STRIDE = 2
"""One in so many rows and columns of clean depth gives points of the true surface."""

LIDAR_SIGMA_M = 0.06
"""The standard deviation of ranges that `benchmarks.lab lidar` learns for 5 cm voxels of this recording."""

IMAGE = "&width=640&height=480"


@dataclass(frozen=True)
class PeerScene:
    """A scene, made when it is needed: with its mesh, or None where only measurements are known."""

    name: str
    make: Callable[[], tuple[Scene, TriangleMesh | None]]
    is_lidar: bool = False

    def case(self, voxel_size: float) -> Case:
        """Its views and its truth for a voxel size."""
        scene, mesh = self._made
        if mesh is None:
            points = along_rays(scene, self.judged, voxel_size)
        else:
            points = of_geometry(scene, mesh, self.mapped, voxel_size)
        return Case(scene, voxel_size, self.mapped, self.judged, points, self._surface)

    @property
    def judged(self) -> Sequence[int]:
        """Numbers of the held-out views."""
        return range(FIRST, len(self._made[0].views), EVERY)

    @property
    def mapped(self) -> Sequence[int]:
        """Numbers of all others."""
        return [i for i in range(len(self._made[0].views)) if i not in self.judged]

    @property
    def selects(self) -> bool:
        """True if there are fewer keyframes than frames."""
        return len(keyframes([self._made[0].views[i] for i in self.mapped])) < len(self.mapped)

    @cached_property
    def _made(self) -> tuple[Scene, TriangleMesh | None]:
        scene, mesh = self.make()
        require_views(scene, FIRST + 2)
        return scene, mesh

    @cached_property
    def _surface(self) -> SurfaceTruth | None:
        scene, mesh = self._made
        if mesh is None:
            return None
        views = [thinned(view, scene, SURFACE_STRIDE) for view in scene.views]
        camera = scene.pinhole.thinned(SURFACE_STRIDE)
        depths, poses = [np.asarray(view.true_m) for view in views], [view.T_world_camera for view in views]
        return surface_truth(depths, poses, camera, self.mapped, [view.judged for view in views])


def peer_scenes(data: Path, seed: int, limit: int | None) -> Sequence[PeerScene]:
    """The scenes; the house and the room are turned, so that no wall lies in a plane of the grid."""
    views = min(VIEWS, limit or VIEWS)

    def kitchen() -> tuple[Scene, TriangleMesh | None]:
        return kitchen_scene(data, views), None

    def room() -> tuple[Scene, TriangleMesh | None]:
        return turned(room_scene(views, IMAGE), scene_mesh(furnished_room()))

    def house() -> tuple[Scene, TriangleMesh | None]:
        return turned(house_scene(data, seed, views), load_mesh(data / "meshes" / "house.ply"))

    def lidar() -> tuple[Scene, TriangleMesh | None]:
        return replace(lidar_scene(data, views), noise=PolynomialNoise((LIDAR_SIGMA_M,))), None

    return [
        PeerScene("kitchen", kitchen),
        PeerScene("room", room),
        PeerScene("house", house),
        PeerScene("lidar", lidar, is_lidar=True),
    ]
