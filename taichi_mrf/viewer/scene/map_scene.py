"""The map in the scene: voxels, the cut, outlines of bricks, and the baseline's map beside it.

Changes are collected, and sent at most :data:`UPDATES_PER_SECOND` times a second.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import viser
import viser.transforms as vtf
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.geometry.up import Up
from taichi_mrf.viewer.messages import BrickColors, Bricks, Hello, Layer, MeasuredPoints, SceneChange
from taichi_mrf.viewer.scene.coloring import CHANGE_COLORS, Scale
from taichi_mrf.viewer.scene.keyframe_layer import draw_lines, placement
from taichi_mrf.viewer.scene.surface_layer import SurfaceLayer
from taichi_mrf.viewer.scene.view_options import ViewOptions
from taichi_mrf.viewer.scene.voxel_layer import Look, VoxelLayer, cut_picture, look_of, show_cut
from taichi_mrf.viewer.scene.voxel_store import Cut, VoxelStore
from taichi_mrf.viewer.scene.widgets import change
from taichi_mrf.voxels.layout import BRICK, grid_keys

UPDATES_PER_SECOND = 8
REST_S = 0.5
"""Without updates for this long, small changes of colour are sent, too."""

_GAP_M = 0.5
"""Distance between the map and the baseline's map, in metres."""

_POINT_SHARE = 0.25
"""Size of a measured point, in voxels."""

_LOWEST_SHARE = 0.02
"""Share of the voxels that may lie below the ground: those that noise has put there."""

_SQUARES_ACROSS = 8
"""The ground has about so many squares along the map's longer side."""

GROWING = "marginal probability"
"""The colouring of voxels in the place of a surface by height, until it is there."""

_NAMES: dict[Layer, str] = {"map": "this map", "baseline": "baseline (OctoMap)"}
_OUTLINE_COLOR = (120, 120, 120)
_GROUND_COLOR = (160, 165, 172)


class MapScene:
    """Owns the scene nodes /voxels, /surface, /measured, /changes, /baseline, /cut, /bricks, /ground and
    /names."""

    def __init__(self, server: viser.ViserServer, hello: Hello) -> None:
        self._server, self.hello = server, hello
        self.layers: dict[Layer, VoxelLayer] = {
            "map": VoxelLayer(server.scene, "/voxels", hello.voxel_size),
            "baseline": VoxelLayer(server.scene, "/baseline", hello.voxel_size),
        }
        self.surface = SurfaceLayer(server.scene, "/surface", hello.voxel_size, self.layers["map"])
        self._voxels = server.scene.add_frame("/voxels", show_axes=False)
        self._options = ViewOptions()
        self._measured: MeasuredPoints | None = None
        self._points: viser.PointCloudHandle | None = None
        self.changes: tuple[SceneChange, ...] = ()
        """Things that have appeared and left lately."""
        self.growing = False
        """True while frames are read: a surface that was made before lacks what they add."""
        self.ground = Ground(server.scene)
        self._all_dirty = True
        self._look: Look | None = None
        self._news_at = self._sent_at = 0.0

    @property
    def store(self) -> VoxelStore:
        """The copy of the map."""
        return self.layers["map"].store

    @property
    def scale(self) -> Scale | None:
        """The colour scale in use; None before anything was drawn, and while neither map is shown."""
        if self._look is None or not (self._options.map or self.has_baseline):
            return None
        return self.surface.scale if self.shows_surface else self._look.scale

    @property
    def shows_surface(self) -> bool:
        """True if the measured surface is shown in the place of voxels: not while the map grows."""
        options = self._options
        drawn = options.map and options.draw_as == "surface"
        return drawn and self.surface.is_complete and not self.growing

    @property
    def shows_voxels(self) -> bool:
        """True if voxels of a map are shown."""
        return self.has_baseline or (self._options.map and not self.shows_surface)

    @property
    def has_baseline(self) -> bool:
        """True if there is a second map."""
        return bool(self.layers["baseline"].store.chunks)

    @property
    def shows_changes(self) -> frozenset[str]:
        """Kinds of change that are marked: something "moves", has "appeared", or has "left"."""
        moves = {"moves"} if self.layers["map"].dynamic_shown else set()
        return frozenset(moves.union(each.verb for each in self.changes) if self._options.changes else ())

    def box_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Lowest and highest corner of all maps that are shown, in metres, world; None if there is none."""
        ends = ((layer.ends_m(), layer.origin_m) for layer in self.layers.values())
        corners = [end + origin_m for end, origin_m in ends if end is not None]
        if not corners:
            return None
        every = np.concatenate(corners)
        return every.min(axis=0), every.max(axis=0)

    @property
    def voxels(self) -> int:
        """Number of voxels of all maps that are shown or stand behind a surface."""
        return sum(layer.voxels_shown for layer in self.layers.values())

    def counts(self) -> dict[str, int]:
        """How many of what is shown, or will be, by name; ``voxels`` also behind a surface."""
        counts: dict[str, int] = {name: layer.voxels_shown for name, layer in self.layers.items()}
        counts |= {"voxels": counts["map"], "dynamic": self.layers["map"].dynamic_shown}
        if self.shows_surface or not self._options.map:
            counts |= {"map": 0, "dynamic": 0}
        if self.shows_surface:
            counts |= {"triangles": self.surface.triangles_shown}
        if self._options.points and self._measured is not None:
            counts |= {"points": len(self._measured.points_m)}
        return counts

    def points(self) -> NDArray[np.float64]:
        """Centres (n, 3) of all voxels of the map that are shown, in metres, world; of the surface its
        vertices."""
        if not self._options.map:
            return np.zeros((0, 3))
        return self.surface.points() if self.shows_surface else self.layers["map"].points()

    def voxel_near(self, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The centre of the voxel of the map at a point (3,) of what is shown: the surface may run through
        the side of one that is not occupied, and then its neighbour is meant."""
        centres = self.layers["map"].points()
        apart_m = np.linalg.norm(centres - point_m, axis=1)
        return centres[np.argmin(apart_m)] if (apart_m < 1.5 * self.hello.voxel_size).any() else point_m

    def voxels_at(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The centres (m, 3) of the shown voxels that some points (n, 3) lie in, metres, world."""
        centres = self.layers["map"].points()
        held, given = (np.floor(each / self.hello.voxel_size) for each in (centres, points_m))
        return centres[np.isin(grid_keys(held.astype(np.int64)), grid_keys(given.astype(np.int64)))]

    def seen_points(self) -> NDArray[np.float64]:
        """Points (n, 3) of all that is seen of both maps, in metres, world."""
        seen = [self.points(), self.layers["baseline"].points()]
        if self._options.points and self._points is not None and self._measured is not None:
            turned = vtf.SO3(self._points.wxyz).apply(self._measured.points_m.astype(np.float64))
            seen.append(turned + self._points.position)
        return np.concatenate(seen)

    def take(self, bricks: Bricks) -> None:
        """Take in changed bricks; :meth:`flush` draws them."""
        layer = self.layers["map" if bricks.layer == "dynamic" else bricks.layer]
        store = layer.dynamic if bricks.layer == "dynamic" else layer.store
        layer.changed |= store.put(bricks.bricks, log_odds=bricks.log_odds, seen=bricks.seen)
        layer.changed |= store.remove(bricks.removed)
        self._news_at = time.monotonic()

    def note_earlier(self) -> None:
        """The map so far is that of an earlier recording: its voxels are pale until today's keyframes change
        them."""
        self.store.note_earlier()
        self.layers["map"].changed |= set(self.store.chunks)

    def paint(self, colors: BrickColors) -> None:
        """Take in colours of the map's bricks; :meth:`flush` draws them."""
        self.layers["map"].changed |= self.store.put(colors.bricks, **{colors.layer: colors.colors})
        self._news_at = time.monotonic()

    def show_measured(self, measured: MeasuredPoints, T_world_camera: Pose) -> None:
        """Show what a keyframe measured, at its pose, if that is a layer that is shown."""
        self._measured = measured
        self._points = self._server.scene.add_point_cloud(
            "/measured",
            points=measured.points_m,
            colors=measured.colors,
            point_size=_POINT_SHARE * self.hello.voxel_size,
            point_shape="circle",
            visible=self._options.points,
        )
        self.move_measured(measured.keyframe, T_world_camera)

    def move_measured(self, keyframe: int, T_world_camera: Pose) -> None:
        """Move the measured points with their keyframe."""
        if self._points is not None and self._measured is not None and self._measured.keyframe == keyframe:
            self._points.wxyz, self._points.position = placement(T_world_camera)

    def look_changed(self) -> None:
        """Draw everything again at the next :meth:`flush`, without waiting for its turn."""
        self._all_dirty = True
        self._sent_at = 0.0

    def clear(self) -> None:
        """Remove everything from the scene."""
        for layer in self.layers.values():
            layer.clear()
        self.surface.clear()
        self.ground.hide()
        self._measured = self._points = None
        for name in ("/measured", "/changes", "/cut", "/bricks", *(f"/names/{layer}" for layer in _NAMES)):
            self._server.scene.remove_by_name(name)

    def patience(self) -> float | None:
        """Seconds until :meth:`flush` has something to do if no update comes; None if it has nothing to
        do."""
        now = time.monotonic()
        if (
            self._all_dirty
            or any(layer.changed for layer in self.layers.values())
            or (self.shows_surface and self.surface.is_stale)
        ):
            return max(0.0, self._sent_at + 1 / UPDATES_PER_SECOND - now)
        inexact = any(layer.inexact() for layer in self.layers.values())
        return max(0.0, self._news_at + REST_S - now) if inexact else None

    def flush(
        self,
        options: ViewOptions,
        up: Up,
        crossed: Iterable[NDArray[np.int32]],
        announce: Callable[[], None] = lambda: None,
    ) -> bool:
        """Send what has changed unless that was done a moment ago; returns whether anything was sent.

        ``crossed`` are bricks (n, 3) that rays cross. ``announce`` is called before the voxels are sent, when
        their number is known: a browser that draws slowly then shows the number first.
        """
        waited = self.patience()
        if waited is None or waited > 0:
            return False
        rested = time.monotonic() >= self._news_at + REST_S
        self._options = options
        first = ViewOptions()
        as_first = (options.draw_as, options.color_by) == (first.draw_as, first.color_by)
        if as_first and not (self.surface.is_complete and not self.growing):
            options = replace(options, color_by=GROWING)
        look = look_of(options, self.store, up, self.hello.voxel_size)
        # A scale of heights or a cut that moves with the map's size changes every chunk.
        everything = self._all_dirty or (self._look is not None and look != self._look)
        map_changed = everything or bool(self.layers["map"].changed)
        any_changed = map_changed or bool(self.layers["baseline"].changed)
        # A cut parts two maps: this one on its one side, the baseline's on the other.
        both = self.has_baseline
        cuts: dict[Layer, Cut | None] = {"map": look.cut, "baseline": look.cut}
        if both and look.cut is not None:
            cuts["baseline"] = look.cut.other_side
        if everything:
            self.surface.outdate(self.surface.patches)
        elif look.coloring.surface is None:
            self.surface.outdate(self.layers["map"].changed)
        for name, layer in self.layers.items():
            layer.prepare(replace(look, cut=cuts[name]), everything, exactly=rested)
        if self.shows_surface:
            self.surface.prepare(look)
        announce()
        with self._server.atomic():
            for layer in self.layers.values():
                layer.send()
            self.surface.send(self.shows_surface)
            change(self._voxels, visible=options.map and not self.shows_surface)
            if self._points is not None:
                change(self._points, visible=options.points)
            if map_changed:
                self._draw_bricks(options.bricks)
                self._draw_changes(options.changes)
            if any_changed:
                self._draw_cut(None if both or not options.free_space else look.cut, crossed)
                self.layers["baseline"].place(np.zeros(3) if look.cut else self._baseline_m(up))
                self._show_space(options, up)
                self._draw_names(up, cuts if both else None)
        self._look, self._all_dirty, self._sent_at = look, False, time.monotonic()
        return True

    def _draw_changes(self, wanted: bool) -> None:
        """Draw boxes around what has appeared and left if they are ``wanted``."""
        scene = self._server.scene
        if not wanted or not self.changes:
            scene.remove_by_name("/changes")
            return
        edges = brick_edges(np.zeros((1, 3), np.int64)) - 0.5
        lines = [np.array(each.centre_m) + edges * each.size_m for each in self.changes]
        colors = np.repeat([CHANGE_COLORS[each.verb] for each in self.changes], len(edges), axis=0)
        ends = np.repeat(colors[:, None], 2, axis=1).astype(np.uint8)
        draw_lines(scene, "/changes", np.concatenate(lines), ends)

    def _show_space(self, options: ViewOptions, up: Up) -> None:
        """Show the axes, and the ground under the map while that has the same box."""
        box = self.box_m()
        if box is None or not options.ground:
            self.ground.hide()
        elif not self.ground.lies_below(*box):
            points = self.layers["map"].points()
            if len(points):
                height_m = up[1] * float(np.quantile(up[1] * points[:, up[0]], _LOWEST_SHARE))
                self.ground.show(*box, up, height_m - up[1] * 0.5 * self.hello.voxel_size)
        change(self._server.scene.world_axes, visible=options.axes)

    def _draw_cut(self, cut: Cut | None, crossed: Iterable[NDArray[np.int32]]) -> None:
        hello, scene = self.hello, self._server.scene
        if cut is None:
            scene.remove_by_name("/cut")
            return
        picture = cut_picture(self.store, cut, hello.prior_log_odds, hello.min_evidence, crossed)
        show_cut(scene, hello.voxel_size, self.store, cut, picture)

    def _draw_bricks(self, wanted: bool) -> None:
        """Draw the outlines of the map's bricks if they are ``wanted``."""
        bricks = self.store.bricks()
        if not wanted or not len(bricks):
            self._server.scene.remove_by_name("/bricks")
            return
        lines = brick_edges(bricks) * BRICK * self.hello.voxel_size
        draw_lines(self._server.scene, "/bricks", lines, _OUTLINE_COLOR, thickness=1.0)

    def _draw_names(self, up: Up, cuts: Mapping[Layer, Cut | None] | None) -> None:
        """Put a label above what is left of each map by its cut, if there are two."""
        for layer, text in _NAMES.items():
            if cuts is None:
                self._server.scene.remove_by_name(f"/names/{layer}")
                continue
            ends = self.layers[layer].ends_m()
            if ends is None:
                continue
            cut = cuts[layer]
            if cut is not None:
                ends[0 if cut.flipped else 1, cut.axis] = cut.plane * self.hello.voxel_size
            above = ends.mean(axis=0) + self.layers[layer].origin_m
            axis, sign = up
            above[axis] = ends[:, axis].max() if sign > 0 else ends[:, axis].min()
            self._server.scene.add_label(f"/names/{layer}", text, position=above)

    def _baseline_m(self, up: Up) -> NDArray[np.float64]:
        """The shift of the baseline's map, in metres: past the map, along a horizontal axis."""
        shift = np.zeros(3)
        ends = self.layers["map"].ends_m()
        if ends is not None:
            axis = 0 if up[0] != 0 else 1
            shift[axis] = ends[1, axis] - ends[0, axis] + _GAP_M
        return shift


def brick_edges(bricks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (n, 2, 3) of the bricks (m, 3), as lattice points; an edge that several bricks share is listed
    once."""
    edges = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for a in (0, 1):
            for b in (0, 1):
                start = bricks.copy()
                start[:, others[0]] += a
                start[:, others[1]] += b
                edges.append(np.column_stack([start, np.full(len(bricks), axis)]))
    unique = np.unique(np.concatenate(edges), axis=0)
    start, axes = unique[:, :3], unique[:, 3]
    return np.stack([start, start + np.eye(3, dtype=np.int64)[axes]], axis=1)


def square_m(extent_m: float) -> float:
    """Width of the ground's squares below a map that is so wide: 1, 2 or 5 times a power of ten."""
    least = max(extent_m / _SQUARES_ACROSS, 1e-3)
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.999 * least))


class Ground:
    """Owns the grid in the scene; its squares are ``square_m`` wide, None without a grid."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._box_m: NDArray[np.float64] | None = None
        self.square_m: float | None = None

    def lies_below(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> bool:
        """True if the grid is that of the box from ``low`` to ``high`` (metres, world)."""
        return self._box_m is not None and np.array_equal(self._box_m, [low, high])

    def show(self, low: NDArray[np.float64], high: NDArray[np.float64], up: Up, height_m: float) -> None:
        """Draw the grid at a coordinate ``height_m`` on the axis ``up``, with lines at whole multiples of a
        square's width, around the box from ``low`` to ``high``."""
        self._box_m = np.stack([low, high])
        level = [axis for axis in range(3) if axis != up[0]]
        square = self.square_m = square_m(float((high - low)[level].max()))
        first, last = np.floor(low / square) - 1, np.ceil(high / square) + 1
        last += (last - first) % 2  # viser draws lines from the middle on
        place = 0.5 * square * (first + last)
        place[up[0]] = height_m
        width, height = (square * (last - first))[level]
        plane: Literal["yz", "xz", "xy"] = ("yz", "xz", "xy")[up[0]]
        self._scene.add_grid(
            "/ground",
            float(width),
            float(height),
            plane=plane,
            cell_thickness=0.0,
            section_size=square,
            section_color=_GROUND_COLOR,
            shadow_opacity=0.0,
            fade_strength=0.0,
            position=place,
        )

    def hide(self) -> None:
        """Remove the grid from the scene."""
        if self._box_m is not None:
            self._scene.remove_by_name("/ground")
            self._box_m = self.square_m = None
