"""The measured surface in the scene: triangles, one mesh for each chunk, in exactly the colours of their
vertices.

viser's own meshes have one colour, or light and shadow of its making. A glTF with KHR_materials_unlit has
neither. Its colours still go through the tone mapping of three.js (ACES, after S. Hill), which is undone
here beforehand; they are floats, because bright colours lie beyond 1.
"""

import json
import struct
from collections.abc import Iterable

import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.viewer.messages import SurfacePatch, SurfaceView
from taichi_mrf.viewer.scene.coloring import Scale
from taichi_mrf.viewer.scene.voxel_layer import Look, VoxelLayer
from taichi_mrf.viewer.scene.voxel_store import Chunk, ChunkKey, Cut, Shown
from taichi_mrf.viewer.scene.widgets import change
from taichi_mrf.voxels.layout import CHUNK_VOXELS

_DARKEST = 0.62
"""Brightness of what the light does not reach."""

_TO_FILM = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_FROM_FILM = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_EXPOSURE = 1 / 0.6

_NEARLY_SAME = 0.999
"""Cosine between the upward directions of two views: less, and the light comes from elsewhere."""

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963


_Mesh = tuple[NDArray[np.int32], bytes]
"""The mesh of a chunk: the vertices of its triangles (m, 3), and its glTF."""


class SurfaceLayer:
    """Owns the scene nodes under ``prefix``."""

    def __init__(self, scene: viser.SceneApi, prefix: str, voxel_size: float, layer: VoxelLayer) -> None:
        """``layer`` has the voxels behind the surface."""
        self._scene, self._prefix, self._voxel_size, self._layer = scene, prefix, voxel_size, layer
        self._root = scene.add_frame(prefix, show_axes=False, visible=False)
        self.patches: dict[ChunkKey, SurfacePatch] = {}
        self._stale: set[ChunkKey] = set()
        self.view: SurfaceView | None = None
        """How to show it."""
        self.scale: Scale | None = None
        """That of what was prepared last."""
        self._prepared: dict[ChunkKey, _Mesh | None] = {}
        self._shown: dict[ChunkKey, NDArray[np.int32]] = {}
        """The triangles of each chunk that clients have."""

    @property
    def is_stale(self) -> bool:
        """True if :meth:`prepare` has something to do."""
        return bool(self._stale)

    @property
    def is_complete(self) -> bool:
        """True if there is a surface, and all of it has been taken in."""
        return self.view is not None and bool(self.patches)

    @property
    def triangles_shown(self) -> int:
        """Number of triangles that clients show once everything prepared has been sent."""
        same = sum(len(shown) for key, shown in self._shown.items() if key not in self._prepared)
        return same + sum(len(mesh[0]) for mesh in self._prepared.values() if mesh is not None)

    def take(self, patch: SurfacePatch) -> None:
        """Take in a changed patch."""
        if len(patch.triangles):
            self.patches[patch.chunk] = patch
        else:
            self.patches.pop(patch.chunk, None)
        self._stale.add(patch.chunk)

    def take_view(self, view: SurfaceView) -> None:
        """Take in how to show the patches that were taken in before. One that differs little from the last
        changes nothing, so that an edit draws only what it changes."""
        if self.view is None or float(self.view.up @ view.up) < _NEARLY_SAME:
            self.view = view
            self.outdate(self.patches.keys())

    def outdate(self, chunks: Iterable[ChunkKey]) -> None:
        """Draw the patches of these chunks again with the next :meth:`prepare`."""
        self._stale |= self.patches.keys() & set(chunks)

    def prepare(self, look: Look) -> None:
        """Make the meshes of the patches that have changed; :meth:`send` sends them."""
        scale = self._scale_of(look)
        if scale != self.scale:  # one of numbers of the surface's own depends on all patches
            self.scale = scale
            self.outdate(self.patches.keys())
        for key in sorted(self._stale):
            patch = self.patches.get(key)
            self._prepared[key] = None if patch is None else self._drawn(patch, look, scale)
        self._stale.clear()

    def send(self, visible: bool) -> None:
        """Send what was prepared, and show or hide it all."""
        for key, mesh in self._prepared.items():
            name = f"{self._prefix}/{key[0]}_{key[1]}_{key[2]}"
            if mesh is None:
                self._shown.pop(key, None)
                self._scene.remove_by_name(name)
            else:
                self._shown[key] = mesh[0]
                self._scene.add_glb(
                    name, mesh[1], position=self._corner_m(key), cast_shadow=False, receive_shadow=False
                )
        self._prepared.clear()
        change(self._root, visible=visible)

    def clear(self) -> None:
        """Remove everything from the scene."""
        self.patches.clear()
        self.view = None
        self._stale.clear()
        self._prepared = dict.fromkeys(self._shown)
        self.send(visible=False)

    def vertices(self) -> NDArray[np.float64]:
        """All vertices (n, 3) in metres, world, shown or not."""
        return np.concatenate([np.zeros((0, 3)), *(patch.vertices_m for patch in self.patches.values())])

    def points(self) -> NDArray[np.float64]:
        """The vertices (n, 3) that are shown, in metres, world."""
        shown = [
            self.patches[key].vertices_m[np.unique(triangles)]
            for key, triangles in self._shown.items()
            if key in self.patches
        ]
        return np.concatenate([np.zeros((0, 3)), *shown])

    def _drawn(self, patch: SurfacePatch, look: Look, scale: Scale) -> _Mesh | None:
        triangles = self._uncut(patch, look.cut)
        if not len(triangles):
            return None
        vertices = (patch.vertices_m - self._corner_m(patch.chunk)).astype(np.float32)
        return triangles, unlit_glb(vertices, triangles, self._colors(patch, look, scale))

    def _uncut(self, patch: SurfacePatch, cut: Cut | None) -> NDArray[np.int32]:
        """The triangles that are not cut away."""
        if cut is None:
            return patch.triangles
        kept = cut.keeps(patch.vertices_m[:, cut.axis] / self._voxel_size)
        return patch.triangles[kept[patch.triangles].all(axis=1)]

    def _scale_of(self, look: Look) -> Scale:
        """That of voxels unless the colours say something else of vertices."""
        measure = look.coloring.surface
        if measure is None or measure is look.coloring.voxels:
            return look.scale
        numbers = [measure.of(each, each.vertices_m, np.array(look.up)) for each in self.patches.values()]
        return measure.scale(np.concatenate(numbers or [np.zeros(0)]), look.heights_m)

    def _colors(self, patch: SurfacePatch, look: Look, scale: Scale) -> NDArray[np.uint8]:
        view = self.view
        assert view is not None  # until then nothing is drawn
        known = patch if look.coloring.surface else self._behind(patch)
        colors = scale.paint(known, patch.vertices_m, np.array(look.up))
        if not look.shade:
            return colors
        lit = np.clip((patch.normals / 127.0) @ view.light, 0.0, 1.0)
        return (colors * (_DARKEST + (1 - _DARKEST) * lit)[:, None] + 0.5).astype(np.uint8)

    def _behind(self, patch: SurfacePatch) -> Shown:
        """The voxels half a side behind the vertices; at the end of the patch's chunk those inside."""
        places = (
            patch.vertices_m - self._corner_m(patch.chunk)
        ) / self._voxel_size - 0.5 * patch.normals / 127.0
        cells = np.clip(np.floor(places), 0, CHUNK_VOXELS - 1).astype(np.int64)
        return self._layer.store.chunks.get(patch.chunk, Chunk()).voxels(cells)

    def _corner_m(self, key: ChunkKey) -> NDArray[np.float64]:
        return np.array(key) * (CHUNK_VOXELS * self._voxel_size)


def unlit_glb(
    vertices: NDArray[np.float32], triangles: NDArray[np.integer], colors: NDArray[np.uint8]
) -> bytes:
    """A .glb of triangles (m, 3) between vertices (n, 3) with colours (n, 3) RGB; they are seen from where
    they run counter-clockwise."""
    small = len(vertices) <= 1 << 16
    parts = (
        (vertices.astype(np.float32), "VEC3", _FLOAT, _VERTICES),
        (before_tone_mapping(colors), "VEC3", _FLOAT, _VERTICES),
        (triangles.reshape(-1).astype(np.uint16 if small else np.uint32), "SCALAR",
         _UINT16 if small else _UINT32, _INDICES),
    )  # fmt: skip
    accessors, views, data = [], [], b""
    for i, (values, kind, number, target) in enumerate(parts):
        accessors.append({"bufferView": i, "componentType": number, "count": len(values), "type": kind})
        content = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content), "target": target})
        data += content + bytes(-len(content) % 4)
    accessors[0] |= {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    scene = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(data), b"BIN\0"), data]
    )


def before_tone_mapping(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The linear light (n, 3) that the tone mapping of three.js turns into colours (n, 3) in sRGB."""
    share = colors / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    film = light @ np.linalg.inv(_FROM_FILM).T
    # The curve is y = (v (v + 0.0245786) - 0.000090537) / (v (0.983729 v + 0.432951) + 0.238081).
    a = 1.0 - 0.983729 * film
    b = 0.0245786 - 0.432951 * film
    c = -0.000090537 - 0.238081 * film
    v = (np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0)) - b) / (2.0 * a)
    return (v @ np.linalg.inv(_TO_FILM).T / _EXPOSURE).astype(np.float32)
