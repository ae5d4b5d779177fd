"""Readings of an MRFMap: its keyframes, and the map as believed at another time, or one layer of it."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import seconds
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.inference.color_sums import ColorShare
from taichi_mrf.inference.dated import DatedBelief
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.inference.messages import count_observations
from taichi_mrf.inference.surface_votes import called
from taichi_mrf.inference.sweep import Sweeper
from taichi_mrf.methods.mrf.calibrated import calibrate, carry
from taichi_mrf.methods.mrf.decided import Decisions
from taichi_mrf.methods.mrf.kept_rays import RayShare
from taichi_mrf.methods.mrf.layers import layer_of
from taichi_mrf.methods.mrf.map_reading import MapReading, RaysThen
from taichi_mrf.methods.mrf.surfacing import LEAST, MadeOf, WithSurface
from taichi_mrf.methods.protocol import MapStatistics, measure
from taichi_mrf.queries.change import MapChange, compare_maps
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.pool import BrickPool, copied
from taichi_mrf.voxels.topology import Topology

ItemT = TypeVar("ItemT")

Layer = Literal["static", "dynamic", "both"]
LAYERS: tuple[Layer, ...] = get_args(Layer)


class ReadableMRF(WithSurface):
    """The part of an MRFMap that changes nothing."""

    _keyframes: dict[int, Keyframe]
    _frozen: dict[int, str]
    _sweeper: Sweeper
    _dated: DatedBelief | None
    _decisions: Decisions
    _decided: "tuple[MadeOf, ti.Ndarray] | None" = None
    _calibrated: "tuple[MadeOf, ti.Ndarray] | None" = None

    @property
    def keyframes(self) -> Mapping[int, Keyframe]:
        """The keyframes that can still be moved and removed, by id."""
        return MappingProxyType(self._keyframes)

    def crossed_bricks(self, id: int) -> NDArray[np.int32]:
        """The bricks that a keyframe's rays cross, (n, 3), whether they are allocated or not."""
        footprint = self._find(id).footprint
        return footprint.window.bricks_of(footprint.crossed)

    def seen_by(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """How many keyframes observe each voxel of some bricks of the pool, (n,) slots -> (n, 512). All
        frozen ones count as one; 255 means 255 or more."""
        sent = [(k.visible, k.messages) for k in self._keyframes.values() if k.messages is not None]
        return count_observations(slots, sent, self._pool)

    @property
    def last_voxel_steps(self) -> int:
        """Voxels that the rays of the last swept keyframe crossed, summed over its rays."""
        return self._sweeper.voxel_steps

    def statistics(self) -> MapStatistics:
        """The size of the map."""
        keyframes = self._keyframes.values()
        return measure(
            self._pool,
            keyframes=len(keyframes),
            frozen=len(self._frozen),
            rays=sum(k.rays for k in keyframes),
            message_bytes=sum(k.voxel_bytes for k in keyframes),
            other_bytes=sum(k.image_bytes for k in keyframes) + self._sweeper.nbytes + self._left_bytes,
        )

    @property
    def has_colors(self) -> bool:
        """True if any voxel may have a colour: a keyframe has been added with a colour image."""
        return bool(self._colors)

    @tensors.in_kind("points")
    def colors(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Colours that cameras saw of the voxels at (N, 3) points in metres, (N, 4) uint8: red, green, blue,
        and how much of the voxel they have seen, 0 for nothing. Each pixel's colour goes to the voxels on its
        ray by the probability that they are what it saw, as of the last :meth:`infer`."""
        self._prepare_colors()
        return self._colors.at(points)

    def colors_in(self, slots: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Colours of the voxels of some bricks of ``view.pool``, (n,) slots -> (n, 512, 4)."""
        self._prepare_colors()
        return self._colors.within(slots)

    def recent_colors(self) -> NDArray[np.uint8]:
        """Colours (slots * 512, 4) while keyframes come, at the price of the new ones: those of others are
        as they were found before (MapColors.follow)."""
        self._restore_messages()
        return self._colors.follow()

    def _keep_share(self, keyframe: Keyframe) -> None:
        """Keep what a keyframe gives to colours, and to surface and reading; it is about to be frozen."""
        self._colors.freeze(keyframe)
        self._keep_rays(keyframe)

    def _restore_shares(self, colors: ColorShare, rays: RayShare) -> None:
        """Add what frozen keyframes of a saved map have left."""
        self._colors.restore(colors)
        self._kept.restore(rays)

    @property
    def _left_bytes(self) -> int:
        """Bytes of the colours, of what frozen keyframes measured, and of the states and the surface that
        were asked for."""
        asked = self._decisions.nbytes
        if self._decided is not None:
            asked += 4 * int(self._decided[1].shape[0])
        if self._calibrated is not None:
            asked += 4 * int(self._calibrated[1].shape[0])
        if self._rendered is not None:
            asked += self._rendered[1].nbytes
        if self._measured is not None:
            asked += self._measured[1].nbytes
        return self._colors.nbytes + self._kept.share.nbytes + asked

    def _prepare_colors(self) -> None:
        if not self._colors.is_current:
            self._restore_messages()

    def _date(self, time: TimeConfig) -> None:
        """Give evidence a date, unless the world is static."""
        self._dated = None
        if not time.is_static:
            self._dated = DatedBelief(self._pool, time, lambda: self._keyframes.values())
            self._pool.dated = self._dated

    @property
    def now_s(self) -> float:
        """The time that the map is for, in seconds: the newest keyframe's stamp; NaN without keyframes."""
        if self._dated is not None:
            now = self._dated.now_s
        else:
            now = max((keyframe.stamp_s for keyframe in self._keyframes.values()), default=-math.inf)
        return now if math.isfinite(now) else math.nan

    def at(self, stamp_s: float) -> MapReading:
        """The map as it was believed at a time in seconds, from the keyframes up to then.

        Frozen keyframes count from the newest of them on. Messages are those of now: they follow from all
        keyframes, also from later ones. Raises ConfigError in a map of a static world
        (``time.half_life_s`` is 0), where keyframes have no order.
        """
        return self.layer("both", stamp_s)

    @property
    def static(self) -> MapReading:
        """The static layer: the map without what came after its surroundings were mapped. Raises ConfigError
        in a map of a static world."""
        return self.layer("static")

    @property
    def dynamic(self) -> MapReading:
        """The dynamic layer: what is occupied now, although all keyframes together say free and show no
        surface near. All else is unknown. Raises ConfigError in a map of a static world."""
        return self.layer("dynamic")

    def layer(self, which: Layer = "both", stamp_s: float | None = None) -> MapReading:
        """One layer of the map, "static" or "dynamic", or "both", which is the whole map, to be queried and
        exported; as it was believed at ``stamp_s`` in seconds, now if None.

        Raises ConfigError for another name, and in a map of a static world, which has "both" only and no
        other time than now.
        """
        if which not in LAYERS:
            raise ConfigError(f"there is no layer {which!r}; known are {', '.join(LAYERS)}")
        if which != "both" or stamp_s is not None:
            what = f"the {which} layer" if which != "both" else "the map of another time"
            dated = self._needs_dates(what)
            self._restore_messages()
        pool = self._pool
        shown = copied(pool.belief) if stamp_s is None else dated.as_of(seconds(stamp_s, "stamp_s"))
        with_frozen = stamp_s is None or self._dated is None or stamp_s >= self._dated.frozen_s
        if which == "both":
            rays = None if stamp_s is None else RaysThen(shown, stamp_s, LEAST * self.prior, with_frozen)
            return MapReading(self, shown, rays)
        dynamic = which == "dynamic"
        belief = layer_of(pool, shown, dynamic, self.voxel_size)
        # All that is dynamic is occupied; what the layer does not know is at the prior.
        least, judging = (0.5, shown) if dynamic else (LEAST * self.prior, belief)
        reading = MapReading(self, belief, RaysThen(judging, stamp_s, least, with_frozen))
        if dynamic:
            reading.seen_free_log_odds = pool.prior_log_odds  # free space belongs to the static layer
        return reading

    @property
    def decided(self) -> MapReading:
        """The map by what is occupied, to be queried, cast rays in, drawn and exported: :meth:`state` answers
        by it.

        Besides the voxels whose marginal is over one half it has those that win the vote of the rays: each
        measured ray votes for the voxel that most likely is its first surface, and against those in front of
        it (inference.surface_votes). A wall that is seen with a sigma of several voxels has no voxel that is
        more likely occupied than not. Log-odds are the calibrated ones (:meth:`calibrated`) as far as the
        states allow, once the map is settled and has a surface; else those of winners are raised to just
        above even odds, and all others are the marginals'. Votes of frozen keyframes are kept with
        ``keep_surface``, else they have none.
        """
        return self.decide()

    def decide(self, between: Callable[[], object] = lambda: None) -> MapReading:
        """:attr:`decided`; ``between`` is called after each keyframe whose votes or distances are found, and
        what it raises ends the work. Raises CapacityError if there is not enough memory."""
        made_of = MadeOf(self)
        if self._decided is None or self._decided[0] != made_of:
            self._decided = None  # its memory, before there is another
            log_odds = self._decisions.log_odds(self._settled, between)
            if self._settled and self.has_surface:
                known = self._pool.prior_log_odds, self.view.volume.min_evidence
                carry(self._calibrated_log_odds(between), log_odds, *known, called(*known))
                runtime.settle()
            self._decided = made_of, log_odds
        # Not kept: a reading keeps the map, whose memory would then wait for the collector of cycles.
        reading = MapReading(self, self._decided[1])
        reading.view.index = self.view.index
        return reading

    def calibrated(self, between: Callable[[], object] = lambda: None) -> MapReading:
        """The map by the probability that each voxel holds a surface, from the distances of all rays
        (methods.mrf.calibrated), which can be trusted as a probability; the marginals are more cautious.
        Found once for each state of the map. ``between`` is called after each keyframe. Raises CapacityError
        if there is not enough memory."""
        return MapReading(self, self._calibrated_log_odds(between))

    def _calibrated_log_odds(self, between: Callable[[], object] = lambda: None) -> "ti.Ndarray":
        made_of = MadeOf(self)
        if self._calibrated is None or self._calibrated[0] != made_of:
            self._calibrated = None
            pool = self._pool
            log_odds, slots = copied(pool.belief), pool.in_use
            calibrate(self.surface_field(between), pool.bricks[slots], slots, log_odds, pool.prior_log_odds)
            self._calibrated = made_of, log_odds
        return self._calibrated[1]

    def _likely_grid(self) -> tuple[float, Topology, BrickPool, float]:
        """Calibrated where distances are at hand, else the marginals."""
        return self.calibrated()._grid() if self.has_surface else self._grid()

    def first_surfaces(self) -> NDArray[np.bool_]:
        """Which voxels of ``view.pool`` win the vote of the rays for their first surface, (slots, 512)."""
        return self._decisions.winners(self._settled)

    def changes(self, since_s: float) -> MapChange:
        """Difference between the map as it was believed at a time in seconds and as it is now: its
        ``appeared`` and ``vanished`` are voxels that were free and are occupied, and the reverse; ``points``,
        ``before`` and ``after`` list all voxels whose state has changed, also those that were seen first
        since then. Raises ConfigError in a map of a static world."""
        return compare_maps(self.at(since_s), self)

    def _needs_dates(self, what: str) -> DatedBelief:
        if self._dated is None:
            raise ConfigError(f"{what} needs a map of a world that may change: set time.half_life_s")
        return self._dated

    def _find(self, id: int) -> Keyframe:
        if id in self._frozen:
            raise KeyframeError(f"keyframe {id} ({self._frozen[id]}) is frozen")
        if id not in self._keyframes:
            raise KeyframeError(f"there is no keyframe {id}")
        return self._keyframes[id]

    def _show(self, slots: NDArray[np.int32], log_odds: NDArray[np.float32]) -> None:
        """Let queries read these log-odds, (n) -> (n, 512), until the next inference."""
        self._pool.write("total", slots, log_odds)
        if self._dated is not None:
            self._dated.show(slots, log_odds, self._dated.now_s)

    def _restore_messages(self) -> None:
        raise NotImplementedError
