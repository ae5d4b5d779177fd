"""An MRFMap as believed at another time, one layer of it, or by what is occupied, as a MapReading."""

from collections.abc import Callable
from typing import Literal, get_args

from taichi_mrf.config.arguments import seconds
from taichi_mrf.errors import ConfigError
from taichi_mrf.inference.dated import DatedBelief
from taichi_mrf.inference.surface_votes import called
from taichi_mrf.methods.mrf.calibrated import calibrate, carry
from taichi_mrf.methods.mrf.inferring import restore_messages
from taichi_mrf.methods.mrf.map_reading import MapReading, RaysThen
from taichi_mrf.methods.mrf.moving_voxels import layer_of
from taichi_mrf.methods.mrf.parts import MapParts
from taichi_mrf.methods.mrf.surfacing import LEAST, surface_field
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.pool import copied

Layer = Literal["static", "dynamic", "both"]
LAYERS: tuple[Layer, ...] = get_args(Layer)


def layer(
    m: OccupancyMap, parts: MapParts, which: Layer = "both", stamp_s: float | None = None
) -> MapReading:
    """MRFMap.layer."""
    if which not in LAYERS:
        raise ConfigError(f"there is no layer {which!r}; choose from {', '.join(LAYERS)}")
    if which != "both" or stamp_s is not None:
        what = f"the {which} layer" if which != "both" else "the map of another time"
        dated = dates_for(parts, what)
        restore_messages(parts)
    pool, unlikely = parts.pool, LEAST * parts.prior
    shown = copied(pool.belief) if stamp_s is None else dated.as_of(seconds(stamp_s, "stamp_s"))
    with_frozen = stamp_s is None or parts.dated is None or stamp_s >= parts.dated.frozen_s
    if which == "both":
        rays = None if stamp_s is None else RaysThen(shown, stamp_s, unlikely, with_frozen)
        return MapReading(m, parts, shown, rays)
    dynamic = which == "dynamic"
    belief = layer_of(pool, shown, dynamic, m.voxel_size)
    # All that is dynamic is occupied; what the layer does not know is at the prior.
    least, judging = (0.5, shown) if dynamic else (unlikely, belief)
    reading = MapReading(m, parts, belief, RaysThen(judging, stamp_s, least, with_frozen))
    if dynamic:
        reading.seen_free_log_odds = pool.prior_log_odds  # free space belongs to the static layer
    return reading


def decide(m: OccupancyMap, parts: MapParts, between: Callable[[], object] = lambda: None) -> MapReading:
    """MRFMap.decide."""

    def found() -> "ti.Ndarray":
        log_odds = parts.decisions.log_odds(parts.settled, between)
        if parts.settled and parts.has_surface:
            known = parts.pool.prior_log_odds, m.view.volume.min_evidence
            carry(calibrated_log_odds(parts, between), log_odds, *known, called(*known))
            runtime.settle()
        parts.decisions.call_matter(log_odds)
        return log_odds

    # Not kept: a reading keeps the map, whose memory would then wait for the collector of cycles.
    return MapReading(m, parts, parts.decided.of(parts, found))


def calibrated(m: OccupancyMap, parts: MapParts, between: Callable[[], object] = lambda: None) -> MapReading:
    """MRFMap.calibrated."""
    return MapReading(m, parts, calibrated_log_odds(parts, between))


def calibrated_log_odds(parts: MapParts, between: Callable[[], object] = lambda: None) -> "ti.Ndarray":
    """Log-odds (capacity * 512) that voxels hold a surface, found once for each state of the map."""

    def found() -> "ti.Ndarray":
        pool = parts.pool
        log_odds, slots = copied(pool.belief), pool.in_use
        field = surface_field(parts, between)
        calibrate(field, pool.bricks[slots], slots, log_odds, pool.prior_log_odds)
        return log_odds

    return parts.calibrated.of(parts, found)


def dates_for(parts: MapParts, what: str) -> DatedBelief:
    """The dated beliefs of a map. Raises ConfigError in a map of a static world, which lacks ``what``."""
    if parts.dated is None:
        raise ConfigError(f"{what} needs a map of a world that may change: set time.half_life_s")
    return parts.dated
