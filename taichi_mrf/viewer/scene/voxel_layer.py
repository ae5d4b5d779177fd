"""The voxels in the scene, as one point cloud for each chunk, and the cut: a layer of voxels as a picture in
its plane.

A chunk is sent again only if its visible voxels changed. In the cut, free voxels are blue, occupied ones
yellow; unknown voxels are transparent, so that free and unknown space look different.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from taichi_mrf.geometry.up import Up, up_vector
from taichi_mrf.viewer.messages import LOG_ODDS_STEP
from taichi_mrf.viewer.scene.coloring import (
    COLORINGS,
    DYNAMIC_COLOR,
    SPACE_COLORS,
    Coloring,
    Ends,
    Scale,
    pale,
    shaded,
)
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_store import ChunkKey, Cut, Shown, VoxelStore, facing
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS

FREE = (*SPACE_COLORS["free"], 110)
OCCUPIED = (*SPACE_COLORS["occupied"], 230)
UNKNOWN = (0, 0, 0, 0)

_MOST_PIXELS = 2048

# Local x, y and z of the picture (columns to the right, rows downwards, away from the reader) as the
# world's axes, for a cut across x, y, z; each is a rotation by a third of a turn or none.
_WXYZ = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_AXES = ((1, 2), (2, 0), (0, 1))


def cut_of(options: ViewOptions, store: VoxelStore, up: Up, voxel_size: float) -> Cut | None:
    """The cut that is asked for, through a layer of the map's voxels; None without, and for an empty map. A
    level cut opens the map from above, wherever that is."""
    bounds = store.bounds()
    if bounds is None or options.cut_axis == "none":
        return None
    axis = "xyz".index(options.cut_axis)
    low, high = int(bounds[0][axis]) * BRICK, int(bounds[1][axis] + 1) * BRICK - 1
    downwards = up == (axis, -1)
    at_m = -options.cut_at_m if downwards else options.cut_at_m
    voxel = int(np.floor(at_m / voxel_size + 1e-6))
    return Cut(axis, min(max(voxel, low), high), options.flip_cut != downwards)


def cut_picture(
    store: VoxelStore,
    cut: Cut,
    prior_log_odds: float,
    min_evidence: float,
    crossed: Iterable[NDArray[np.int32]],
) -> NDArray[np.uint8]:
    """The layer of voxels at the cut, (rows, columns, 4) RGBA, one pixel a voxel.

    Columns follow the first and rows the second of the axes after the cut's; the picture covers
    :meth:`VoxelStore.bounds`. ``crossed`` are bricks (n, 3) that rays cross; they are free unless the store
    holds them. Free, occupied and unknown are defined as in queries.points.classify.
    """
    columns, rows = _AXES[cut.axis]
    bounds = store.bounds()
    assert bounds is not None
    low, high = bounds
    size = (high - low + 1) * BRICK
    picture = np.zeros((size[rows], size[columns], 4), np.uint8)
    here = [bricks[bricks[:, cut.axis] == cut.voxel // BRICK][:, [rows, columns]] for bricks in crossed]
    seen = np.zeros((size[rows] // BRICK, size[columns] // BRICK), bool)
    for bricks in here:
        at = bricks - low[[rows, columns]]
        at = at[((at >= 0) & (at < seen.shape)).all(axis=1)]
        seen[at[:, 0], at[:, 1]] = True
    picture[np.kron(seen, np.ones((BRICK, BRICK), bool))] = FREE
    for key, chunk in store.chunks.items():
        if key[cut.axis] != cut.voxel // CHUNK_VOXELS:
            continue
        cells, packed = chunk.slab(cut.axis, cut.voxel % CHUNK_VOXELS)
        if columns > rows:  # a slab lists the axes that are left in their own order
            cells = cells[:, ::-1]
        at = cells[:, ::-1] + (np.array(key)[[rows, columns]] * CHUNK - low[[rows, columns]]) * BRICK
        picture[at[:, 0], at[:, 1]] = _classes(packed * LOG_ODDS_STEP, prior_log_odds, min_evidence)
    return picture


def show_cut(
    scene: viser.SceneApi, voxel_size: float, store: VoxelStore, cut: Cut, picture: NDArray[np.uint8]
) -> None:
    """Show a :func:`cut_picture` in the plane of the cut, as the scene node /cut."""
    bounds = store.bounds()
    assert bounds is not None
    low_m = bounds[0] * BRICK * voxel_size
    high_m = (bounds[1] + 1) * BRICK * voxel_size
    centre = (low_m + high_m) / 2
    centre[cut.axis] = cut.plane * voxel_size
    columns, rows = _AXES[cut.axis]
    shrink = -(-max(picture.shape[:2]) // _MOST_PIXELS)
    if shrink == 1:  # so that the edges of voxels stay sharp when seen from near
        grow = max(1, _MOST_PIXELS // (4 * max(picture.shape[:2])))
        picture = cv2.resize(picture, None, fx=grow, fy=grow, interpolation=cv2.INTER_NEAREST)
    else:
        picture = np.ascontiguousarray(picture[::shrink, ::shrink])
    scene.add_image(
        "/cut",
        picture,
        float((high_m - low_m)[columns]),
        float((high_m - low_m)[rows]),
        format="png",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=_WXYZ[cut.axis],
        position=centre,
    )


def _classes(log_odds: NDArray[np.floating], prior_log_odds: float, min_evidence: float) -> NDArray[np.uint8]:
    """Colours (n, 4) of log-odds (n,)."""
    colors = np.zeros((len(log_odds), 4), np.uint8)
    colors[log_odds < prior_log_odds - min_evidence] = FREE
    colors[(log_odds > 0) & (np.abs(log_odds - prior_log_odds) > min_evidence)] = OCCUPIED
    return colors


NOTICEABLE = 12
"""A change of colour of at most this (of 255, in any channel) is not sent until no more updates come."""


@dataclass(frozen=True)
class Look:
    """Settings of a chunk's look: if they are equal, a voxel that has not changed looks the same."""

    log_odds: float
    cut: Cut | None
    coloring: Coloring
    scale: Scale
    """That of voxels."""
    heights_m: Ends = field(compare=False)
    """The lowest and the highest of the map: what depends on them is in the scale."""
    point_size: float
    """In voxels."""
    shade: bool
    changes: bool
    up: tuple[float, ...]
    """A unit vector in the world."""

    def paint(
        self, shown: Shown, centres_m: NDArray[np.floating], facing: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Colours (n, 3) of voxels with centres (n, 3) in the world, whose surfaces face there."""
        colors = self.scale.paint(shown, centres_m, np.array(self.up, np.float32))
        return shaded(colors, facing) if self.shade else colors


@dataclass
class _Sent:
    """Voxels of a chunk that clients have. ``exact`` is false if colours have changed a little since."""

    cells: NDArray[np.uint8]
    colors: NDArray[np.uint8]
    point_size: float
    dynamic: int
    """How many of the voxels have the colour of dynamic ones."""
    exact: bool = True

    @property
    def nbytes(self) -> int:
        """Bytes of points (float16) and colours."""
        return len(self.cells) * 9


class VoxelLayer:
    """Owns the scene nodes under ``prefix``.

    ``dynamic`` holds the dynamic voxels of the same map. They differ in colour and are no points of their
    own, which would flicker in the place of others.
    """

    def __init__(self, scene: viser.SceneApi, prefix: str, voxel_size: float) -> None:
        self._scene, self._prefix, self._voxel_size = scene, prefix, voxel_size
        self.store, self.dynamic = VoxelStore(), VoxelStore()
        self.changed: set[ChunkKey] = set()
        """Chunks whose stores have changed since the last :meth:`prepare`."""
        self.origin_m = np.zeros(3)
        self.bytes_sent = 0
        self._sent: dict[ChunkKey, _Sent] = {}
        self._prepared: dict[ChunkKey, _Sent | None] = {}
        self._nodes: dict[ChunkKey, viser.PointCloudHandle] = {}

    @property
    def voxels_shown(self) -> int:
        """Number of voxels that clients show once everything prepared has been sent."""
        return sum(len(each.cells) for each in self._ahead())

    @property
    def dynamic_shown(self) -> int:
        """How many of them have the colour of dynamic voxels."""
        return sum(each.dynamic for each in self._ahead())

    def ends_m(self) -> NDArray[np.float64] | None:
        """Lowest and highest corner (2, 3) in metres from the origin of the layer; None if it is empty."""
        bounds = self.store.bounds()
        return None if bounds is None else np.stack([bounds[0], bounds[1] + 1]) * BRICK * self._voxel_size

    def place(self, origin_m: NDArray[np.float64]) -> None:
        """Move the whole layer to another origin, (3,) in metres, world."""
        self.origin_m = origin_m
        for key, node in self._nodes.items():
            node.position = self._position(key)

    def prepare(self, look: Look, everything: bool, exactly: bool) -> None:
        """Find out what must be sent of chunks that have changed, or of ``everything``; :meth:`send` sends
        it. Unless ``exactly``, small changes of colour are left for later."""
        chunks = set(self.store.chunks) | set(self._sent) if everything else self.changed
        for key in sorted(chunks | (self.inexact() if exactly else set())):
            self._prepare_chunk(key, look, exactly)
        self.changed = set()

    def send(self) -> None:
        """Send what was prepared."""
        for key, now in self._prepared.items():
            if now is None:
                self._take_out(key)
            else:
                self._send(key, now)
        self._prepared.clear()

    def inexact(self) -> set[ChunkKey]:
        """Chunks with small changes of colour that were left for later."""
        return {key for key, sent in self._sent.items() if not sent.exact}

    def clear(self) -> None:
        """Remove everything from the scene and from the store."""
        self.store, self.dynamic = VoxelStore(), VoxelStore()
        self._prepared.clear()
        for key in list(self._sent):
            self._take_out(key)

    def _ahead(self) -> list[_Sent]:
        """Voxels of each chunk that clients have once everything prepared has been sent."""
        ahead: dict[ChunkKey, _Sent | None] = {**self._sent, **self._prepared}
        return [each for each in ahead.values() if each is not None]

    def points(self) -> NDArray[np.float64]:
        """Centres (n, 3) in metres, in the world, of all voxels that are shown."""
        centres = [np.zeros((0, 3))]
        for key, sent in self._sent.items():
            centres.append(sent.cells * self._voxel_size + self._position(key))
        return np.concatenate(centres)

    def _prepare_chunk(self, key: ChunkKey, look: Look, exactly: bool) -> None:
        shown = self.store.shown(key, look.log_odds, look.cut)
        before = self._sent.get(key)
        if not len(shown.cells):
            if before is not None:
                self._prepared[key] = None
            return
        first_m = ((np.array(key) * CHUNK_VOXELS + 0.5) * self._voxel_size).astype(np.float32)
        centres_m = shown.cells * np.float32(self._voxel_size) + first_m
        colors = look.paint(shown, centres_m, facing(shown.cells))
        colors[shown.is_earlier] = pale(colors[shown.is_earlier])
        dynamic = self._is_dynamic(key, shown.cells) & look.changes
        colors[dynamic] = DYNAMIC_COLOR
        now = _Sent(shown.cells, colors, look.point_size, int(dynamic.sum()))
        if before is not None and np.array_equal(before.cells, now.cells):
            moved = np.abs(before.colors.astype(np.int16) - now.colors).max()
            if before.point_size != now.point_size:
                self._nodes[key].point_size = now.point_size
                before.point_size = now.point_size
            before.dynamic = now.dynamic
            if moved == 0:
                before.exact = True
                return
            if moved <= NOTICEABLE and not exactly:
                before.exact = False
                return
        self._prepared[key] = now

    def _is_dynamic(self, key: ChunkKey, cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which of a chunk's voxels (n, 3) are dynamic, (n,)."""
        across = np.array([CHUNK_VOXELS**2, CHUNK_VOXELS, 1], np.int32)
        return np.isin(cells @ across, self.dynamic.shown(key, 0.0, None).cells @ across)

    def _send(self, key: ChunkKey, now: _Sent) -> None:
        self._nodes[key] = self._scene.add_point_cloud(
            self._name(key),
            points=now.cells.astype(np.float16),
            colors=now.colors,
            point_size=now.point_size,
            point_shape="square",
            precision="float16",
            scale=self._voxel_size,
            position=self._position(key),
        )
        self._sent[key] = now
        self.bytes_sent += now.nbytes

    def _take_out(self, key: ChunkKey) -> None:
        self._nodes.pop(key).remove()
        del self._sent[key]

    def _name(self, key: ChunkKey) -> str:
        return f"{self._prefix}/{key[0]}_{key[1]}_{key[2]}"

    def _position(self, key: ChunkKey) -> NDArray[np.float64]:
        """Position of the centre of the chunk's first voxel, the origin of its points, in metres, world."""
        return self.origin_m + (np.array(key) * CHUNK_VOXELS + 0.5) * self._voxel_size


def look_of(options: ViewOptions, store: VoxelStore, up: Up, voxel_size: float) -> Look:
    """How the voxels of a map look; heights of the surface have the same range."""
    log_odds = float(np.log(options.threshold / (1 - options.threshold)))
    coloring = COLORINGS[options.color_by]
    some, centres = store.sample(log_odds)
    centres_m, upward = voxel_size * centres, up_vector(up)
    heights_m = _ends(centres_m @ upward, 2 * voxel_size)
    return Look(
        log_odds=log_odds,
        cut=cut_of(options, store, up, voxel_size),
        coloring=coloring,
        scale=coloring.voxels.scale(coloring.voxels.of(some, centres_m, upward), heights_m),
        heights_m=heights_m,
        point_size=options.size,
        shade=options.shade,
        changes=options.changes,
        up=tuple(upward.tolist()),
    )


def _ends(heights_m: NDArray[np.float64], step_m: float) -> Ends:
    """The lowest and the highest of some heights, in whole steps; stray ones do not count."""
    floor_m, top_m = np.quantile(heights_m, [0.005, 0.995]) if len(heights_m) else (0.0, step_m)
    return float(np.floor(floor_m / step_m)) * step_m, float(np.ceil(top_m / step_m)) * step_m
