"""Makers of what the page shows beside the map, each of one map: its measured surface, the list of what
appeared in the scene or left it, the colours that cameras saw, and its keyframes mapped by OctoMap's method.

Each remembers what was sent, and finds what has changed since.
"""

import hashlib
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Config, without_window
from taichi_mrf.config.sections import TimeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.evaluation.pictures.room_views import PHOTO_VOXEL_M, DrawnSurface, smooth_borders
from taichi_mrf.evaluation.pictures.surfaces import up_direction, upward_axis
from taichi_mrf.evaluation.pictures.viewpoint import LIGHT, PERSPECTIVE, overview_pose
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Z_UP
from taichi_mrf.inference.schedule import Progress
from taichi_mrf.methods.capabilities import has_dates, measures_surface, takes_colors
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.queries.change import compare_maps
from taichi_mrf.queries.changed_things import find_changed_things, without_slack
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.publish import Publisher
from taichi_mrf.viewer.messages import (
    BrickColors,
    Bricks,
    SceneChange,
    SceneChanges,
    SurfacePatch,
    SurfaceView,
    Update,
)
from taichi_mrf.voxels.layers import LAYERS, Chunk, imported, pixel_layers
from taichi_mrf.voxels.layout import BRICK, VOXELS, by_chunk, grid_keys


def lack_of_surface(m: OccupancyMap) -> str:
    """In words, why no surface can be made of a map; empty if there is one, or will be with keyframes."""
    if not measures_surface(m):
        return f"a map of the method {m.config.method} has none"
    if m.keeps_surface or not m.frozen:
        return ""
    text = f"the images of {len(m.frozen)} frozen keyframes are no longer in memory"
    return f"{text}; --keep-surface keeps what they say of it"


class ShownSurface:
    """Makes the measured surface of one map anew when that has changed, chunk by chunk, and a view of it."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._sent: dict[Chunk, bytes] = {}
        self._tried_at: tuple[int, int] | None = None

    @property
    def is_current(self) -> bool:
        """True if the map has not changed since the last try."""
        return self._tried_at == self._state

    def news(self, between: Callable[[], object]) -> list[Update]:
        """The patches that have changed, and then how to look at the surface. ``between`` is called many
        times in a second; what it raises ends the work. Raises ConfigError if the map cannot make a surface
        of all its keyframes, CapacityError, TaichiMRFError."""
        m, state = self._mapper.map, self._state
        if not measures_surface(m) or lack_of_surface(m):
            raise ConfigError(lack_of_surface(m))
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


def _view(surface: DrawnSurface, m: MRFMap) -> SurfaceView:
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
        None,
    )


def _digest(patch: SurfacePatch) -> bytes:
    hashed = hashlib.blake2b(digest_size=8)
    for part in (patch.vertices_m, patch.triangles, patch.std_m, patch.colors):
        hashed.update(b"" if part is None else np.ascontiguousarray(part).tobytes())
    return hashed.digest()


MOST_LISTED = 6

REACH_M = 0.1
"""Parts that are nearer to each other than this are one thing."""

LEAST_VOLUME_M3 = 0.003
"""Smaller clusters of changed voxels are not listed: edges of surfaces change with noise. The surface of a
ball of 25 cm radius that one view sees has twice this volume in voxels of 5 cm."""

LEAST_VOXELS = 24
"""As many voxels of 5 cm have that volume. Fewer of larger ones come and go where a lidar's rays are far
apart."""

SHARE_OF_TIME = 0.05
"""Comparisons take at most this share of the time."""


class ChangeList:
    """Changes in the scene of one map, the latest first: the map now against the map as it was believed at
    the last comparison."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._changes: deque[SceneChange] = deque(maxlen=MOST_LISTED)
        self._compared_s: float | None = None  # the newest stamp at the last comparison
        self._next = 0.0
        side_m = mapper.map.voxel_size
        self._least = max(LEAST_VOXELS, round(LEAST_VOLUME_M3 / side_m**3))

    def look(self) -> list[SceneChanges]:
        """Compare the map with the one before if keyframes have come since; returns the update to send, if
        there is one. Raises TaichiMRFError."""
        m, begin = self._mapper.map, time.monotonic()
        if not has_dates(m) or begin < self._next:
            return []
        stamps = [keyframe.stamp_s for keyframe in m.keyframes.values()]
        if not stamps:
            return []
        before_s, self._compared_s = self._compared_s, max(stamps)
        self._next = math.inf  # if it fails, it is not tried again
        if before_s is None or self._compared_s <= before_s:
            self._next = 0.0
            return []
        before = m.layer(stamp_s=before_s)
        change = compare_maps(before, m.marginals, self._seen_since(before_s))
        change = without_slack(change, before, m, core=self._least)
        things = find_changed_things(change, m.voxel_size, self._least, max(REACH_M, m.voxel_size))
        seconds = time.monotonic() - begin
        self._next = begin + seconds / SHARE_OF_TIME
        for thing in reversed(things):
            size, centre = thing.size_m.tolist(), thing.centre_m.tolist()
            self._changes.appendleft(SceneChange(self._compared_s, thing.verb, tuple(size), tuple(centre)))
        return [self.listed()] if things else []

    def listed(self) -> SceneChanges:
        """The changes so far."""
        return SceneChanges(tuple(self._changes))

    def _seen_since(self, stamp_s: float) -> NDArray[np.int32]:
        """The bricks (n, 3) with voxels that rays of later keyframes cross. Elsewhere nothing has changed but
        that evidence has grown older."""
        m, pool = self._mapper.map, self._mapper.map.view.pool
        later = [id for id, keyframe in m.keyframes.items() if keyframe.stamp_s > stamp_s]
        crossed = np.concatenate([np.zeros((0, 3), np.int32), *map(m.crossed_bricks, later)])
        bricks = pool.bricks[pool.in_use]
        return bricks[np.isin(grid_keys(bricks), grid_keys(crossed))]


COLOR_SHARE = 0.1
"""Looking for new colours takes at most this share of the time while frames come."""

LEAST_LOG_ODDS = 0.0
"""Bricks without any voxel more likely occupied than not are not sent: in this map every brick that a ray
crosses exists, seven in ten of them free at 2 cm, and a voxel seen to be free never falls below 0.12."""


class ShownColors:
    """Finds the colours to send of one map, of each layer that pixels feed. While keyframes come, only what
    these give is added; once the map has settled, all is computed from its final marginals."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._sent: dict[tuple[str, Chunk], bytes] = {}
        self._next = -math.inf
        self._seen: tuple[int, bool, int] | None = None

    def changes(self) -> list[BrickColors]:
        """The colours of the chunks that have changed since the last call, chunk by chunk; none if that was a
        moment ago."""
        m, begin = self._mapper.map, time.monotonic()
        if not takes_colors(m) or (begin < self._next and not m.settled):
            return []
        layers = {name: layer for name, layer in m.pixel_layers.items() if layer}
        if not layers:
            return []
        pool = m.view.pool
        state = pool.revision, m.settled, len(m.keyframes)
        if state == self._seen:
            return []
        self._seen = state
        slots = pool.in_use
        news = []
        for name, layer in layers.items():
            painted, shape = imported(pixel_layers()[name].page.painted), (-1, VOXELS, *LAYERS[name].shape)
            found = layer.within(slots) if m.settled else layer.follow().reshape(shape)[slots]
            for chunk, rows in by_chunk(pool.bricks[slots]):
                colors = painted(found[rows])
                digest = hashlib.blake2b(colors.tobytes(), digest_size=8).digest()
                if self._sent.get((name, chunk)) != digest:
                    self._sent[name, chunk] = digest
                    bricks = np.ascontiguousarray(pool.bricks[slots[rows]])
                    news.append(BrickColors(chunk, bricks, colors, name))
        now = time.monotonic()
        self._next = now + (now - begin) / COLOR_SHARE
        return news


class BaselineOverlay:
    """A map by OctoMap's method that follows a mapper's keyframes, one piece of work at a time."""

    def __init__(self, config: Config, noise: NoiseModel) -> None:
        """An empty map with a configuration's parameters, but for the window, colours and kept surfaces,
        which its method lacks, and for time: OctoMap's update forgets nothing."""
        static = replace(without_window(config), time=TimeConfig(), color=False, keep_surface=False)
        self.map: OccupancyMap = octomap_method().load_class().with_noise(static, noise)
        self._publisher = Publisher(
            "baseline",
            self.map.view.pool,
            self.map.seen_by,
            prior_is_unknown=True,
            least_log_odds=LEAST_LOG_ODDS,
        )
        self._places: dict[int, tuple[int, Pose]] = {}
        """The viewer's number of a keyframe -> its number and pose here."""
        self._stale = False

    def catch_up(self, mapper: Mapper, progress: Progress) -> bool:
        """Do one piece of the work that is left: add a keyframe, or integrate all anew after some have gone
        or moved, which ``progress`` can stop. Returns whether there was any.

        A frozen keyframe that is in this map stays in it; one that was frozen before cannot be added.
        """
        entries = mapper.roster.entries
        for id, (here, pose) in list(self._places.items()):
            entry = entries.get(id)
            if entry is None or entry.state == "off":
                self.map.remove_keyframe(here)
                del self._places[id]
                self._stale = True
            elif not np.array_equal(entry.T_world_camera, pose):
                self.map.move_keyframe(here, entry.T_world_camera)
                self._places[id] = here, entry.T_world_camera
                self._stale = True
        if self._stale:
            self._stale = not self.map.infer(progress=progress).complete
            return True
        for entry in mapper.roster.with_state("on"):
            if entry.id not in self._places:
                image = mapper.posed_image(entry)
                parts = (entry.T_world_camera, entry.camera, entry.name, entry.stamp_s)
                here = self.map.add_keyframe(image.depth_m, *parts, **image.own.arguments())
                self._places[entry.id] = here, entry.T_world_camera
                return True
        return False

    def changes(self) -> Bricks | None:
        """The changes that were not sent yet; None while the map is being rebuilt."""
        return None if self._stale else self._publisher.changes()

    def everything_gone(self) -> Bricks:
        """The update that removes this map from the page."""
        return self._publisher.everything_gone()
