"""The measured surface, as the page shows it: what has changed of it since it was sent, chunk by chunk, and
from where to look at it."""

import hashlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.pictures.overview import LIGHT, PERSPECTIVE, height_span
from taichi_mrf.evaluation.pictures.surface_view import PHOTO_VOXEL_M, DrawnSurface, smooth_borders
from taichi_mrf.evaluation.pictures.surfaces import up_direction, upward_axis
from taichi_mrf.evaluation.pictures.viewpoint import overview_pose
from taichi_mrf.geometry.up import Z_UP
from taichi_mrf.methods.capabilities import MeasuringMap, measures_surface
from taichi_mrf.queries.colored import marginals_behind
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.viewer.messages import SurfacePatch, SurfaceView, Update, pack_log_odds
from taichi_mrf.voxels.layout import BRICK, by_chunk

Chunk = tuple[int, int, int]

_SUREST = 1 - 1e-6


class ShownSurface:
    """Makes the surface of one map anew when that has changed."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._sent: dict[Chunk, bytes] = {}
        self._tried_at: tuple[int, int] | None = None

    @property
    def is_current(self) -> bool:
        """Whether the map has not changed since the last try."""
        return self._tried_at == self._state

    def news(self, between: Callable[[], object]) -> list[Update]:
        """The patches that have changed, and then how to look at the surface. ``between`` is called many
        times in a second; what it raises ends the work. Raises ConfigError if the map cannot make a surface
        of all its keyframes, CapacityError, TaichiMRFError."""
        m, state = self._mapper.map, self._state
        if not measures_surface(m):
            raise ConfigError(f"a map of the method {m.config.method} has none")
        if not m.has_surface:
            frozen = len(self._mapper.roster.with_state("frozen"))
            text = f"the images of {frozen} frozen keyframes are no longer in memory"
            raise ConfigError(f"{text}; --keep-surface keeps what they say of it")
        found = m.surface(between)
        vertices_m = smooth_borders(found.vertices_m, found.triangles)
        surface = DrawnSurface(vertices_m, found.triangles, found.normals, found.colors)
        patches = self._changed(self._by_chunk(surface, found.std_m))
        view = [_view(surface, m)] if patches and len(surface.triangles) else []
        self._tried_at = state
        return [*patches, *view]

    def nothing(self) -> list[SurfacePatch]:
        """Note that there is no surface of the map as it is now, and try again when it has changed; returns
        the patches that remove what was sent."""
        self._tried_at = self._state
        return self._changed({})

    def _by_chunk(self, surface: DrawnSurface, std_m: NDArray[np.float32]) -> dict[Chunk, SurfacePatch]:
        m = self._mapper.map
        normals = np.rint(127 * surface.normals).astype(np.int8)
        log_odds = pack_log_odds(_log_odds(marginals_behind(m, surface.vertices_m, surface.normals)))
        found: dict[Chunk, SurfacePatch] = {}
        first = surface.vertices_m[surface.triangles[:, 0]]
        bricks = np.floor(first / (BRICK * m.voxel_size)).astype(np.int32)
        for chunk, rows in by_chunk(bricks):
            used, corners = np.unique(surface.triangles[rows], return_inverse=True)
            found[chunk] = SurfacePatch(
                chunk,
                surface.vertices_m[used].astype(np.float32),
                corners.reshape(-1, 3).astype(np.int32),
                normals[used],
                std_m[used],
                log_odds[used],
                None if surface.colors is None else surface.colors[used],
            )
        return found

    def _changed(self, found: dict[Chunk, SurfacePatch]) -> list[SurfacePatch]:
        """Those that differ from what was sent, and empty ones for those that are gone."""
        news = []
        for chunk in self._sent.keys() - found.keys():
            del self._sent[chunk]
            news.append(_without_triangles(chunk))
        for chunk, patch in found.items():
            digest = _digest(patch)
            if self._sent.get(chunk) != digest:
                self._sent[chunk] = digest
                news.append(patch)
        return news

    @property
    def _state(self) -> tuple[int, int]:
        m = self._mapper.map
        return m.view.pool.revision, len(m.keyframes)


def _view(surface: DrawnSurface, m: MeasuringMap) -> SurfaceView:
    """How the picture of a run shows the surface."""
    vertices_m, keyframes = surface.vertices_m, m.keyframes.values()
    up = up_direction(map(upward_axis, keyframes), surface.normals, m.up or Z_UP)
    T_world_eye = overview_pose(vertices_m, surface.normals, up, PERSPECTIVE, m.voxel_size)
    R, eye_m = T_world_eye[:3, :3], T_world_eye[:3, 3]
    away_m = float(np.median((vertices_m - eye_m) @ R[:, 2]))
    return SurfaceView(
        eye_m,
        eye_m + away_m * R[:, 2],
        up,
        R @ LIGHT,
        2.0 * float(np.arctan(0.5 * PERSPECTIVE.height / PERSPECTIVE.fy)),
        *height_span(vertices_m @ up, m.voxel_size),
        photo=surface.colors is not None and m.voxel_size <= PHOTO_VOXEL_M,
    )


def _without_triangles(chunk: Chunk) -> SurfacePatch:
    nothing = np.zeros((0, 3))
    return SurfacePatch(
        chunk,
        nothing.astype(np.float32),
        nothing.astype(np.int32),
        nothing.astype(np.int8),
        np.zeros(0, np.float32),
        np.zeros(0, np.int16),
        None,
    )


def _digest(patch: SurfacePatch) -> bytes:
    hashed = hashlib.blake2b(digest_size=8)
    for part in (patch.vertices_m, patch.triangles, patch.std_m, patch.log_odds, patch.colors):
        hashed.update(b"" if part is None else np.ascontiguousarray(part).tobytes())
    return hashed.digest()


def _log_odds(p: NDArray[np.float32]) -> NDArray[np.float32]:
    within = np.clip(p.astype(np.float64), 1 - _SUREST, _SUREST)
    return np.log(within / (1 - within)).astype(np.float32)
