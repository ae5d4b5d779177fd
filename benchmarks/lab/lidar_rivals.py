"""The measurement model of wavemap as a rival on lidar scans: with its published parameters, and tuned.

Parameters are tuned one after the other: how wide beams are, how many of them update a voxel, how exact their
ranges are, and how much of their evidence counts.
"""

from collections.abc import Callable
from dataclasses import asdict, replace

from taichi_mrf.config.sections import WavemapConfig
from taichi_mrf.evaluation.experiments.contenders import Contender, wavemap

TUNED = "wavemap-style, tuned"

BOUNDS = {
    "angle_sigma_deg": (0.01, 2.0),
    "range_sigma": (0.01, 1.0),
    "scaling_free": (0.04, 0.9),
    "scaling_occupied": (0.04, 0.9),
}
"""Between these parameters are tuned."""


def contender_of(config: WavemapConfig, name: str = "") -> Contender:
    """Maps with these parameters, which are also its name unless one is given."""
    return wavemap(name or f"wavemap-style ({in_words(config)})", **asdict(config))


def in_words(config: WavemapConfig) -> str:
    """Tuned parameters."""
    return (
        f"{config.beams}, {config.angle_sigma_deg:g}°, {config.range_sigma * 100:g} cm, "
        f"free {config.scaling_free:g}, occupied {config.scaling_occupied:g}"
    )


def tuned_parameters(voxel_size: float, score: Callable[[Contender], float]) -> WavemapConfig:
    """The parameters whose maps score best, found by doubling or halving the published ones as long as that
    helps."""

    def scored(config: WavemapConfig) -> float:
        return score(contender_of(config))

    def along(config: WavemapConfig, name: str, factor: float) -> WavemapConfig:
        value = round(factor * getattr(config, name), 4)
        if not BOUNDS[name][0] <= value <= BOUNDS[name][1]:
            return config
        further = replace(config, **{name: value})
        return along(further, name, factor) if scored(further) > scored(config) else config

    published = WavemapConfig()
    found = along(
        replace(published, range_sigma=published.range_sigma_at(voxel_size)), "angle_sigma_deg", 2.0
    )
    found = max([found, replace(found, beams="nearest"), replace(found, beams="ray")], key=scored)
    for name in ("range_sigma", "scaling_free", "scaling_occupied"):
        found = max([along(found, name, 0.5), along(found, name, 2.0)], key=scored)
    return found
