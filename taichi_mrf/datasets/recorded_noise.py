"""A recording's own facts of its sensor, put into the parameters: the noise of depth that a stereo
calibration gives, how far depths reach, which voxels fit them, and that a lidar's beams pass what fills only
a part of a voxel."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.files import shipped_configs
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config, SensorConfig, load
from taichi_mrf.datasets.base import Dataset
from taichi_mrf.errors import BackendError, ConfigError, FrameError
from taichi_mrf.sensor.noise import curves_of

RIG = "stereo"
"""The shipped parameters of a stereo rig, whose sigma stands for one that is not known."""

MUCH = 0.1
"""Share of the measurements that may lie beyond the range."""

USEFUL = 0.03
"""Sigma over depth up to which the range follows the measurements."""

LONG_RAY = 10.0
"""A measured ray is long if it is on average longer than so many times what ``inference.surface_density``
expects."""

SHORT_RAYS_FLOOR = 0.01
"""Density of outliers, per metre, where rays are short. The prior is less sure than this of what ends a long
one, so that those would be taken for outliers."""

FARTHEST_M = 10_000.0
"""No measurement is farther; what claims to be gets no range of its own."""

FILLED, FARTHEST_OTHER = 0.03, 0.9
"""A number that so many measurements are, and all others are at most so much of it, may be no measurement."""

FINEST, COARSEST = 0.01, 0.1
"""Shares of the median depth between which a voxel's size fits."""

ABSURD = 0.5
"""Share of the median depth above which a voxel's size is a slip."""

_UNITS = (("cm", 100), ("mm", 1000))

LOOKED_AT = 3
"""Frames whose depths are looked at: the first, the middle and the last one."""


def with_recorded_noise(settings: Config, dataset: Dataset) -> Config:
    """The parameters with the recording's own origin, sigma, reach, ``pass_through``, density of outliers and
    voxel size in place of the defaults; adds notes to the dataset. What the user has set stays, and a sigma
    or sigma table that is set is that of all pixels. Raises ConfigError if a voxel is larger than half the
    median depth."""
    depths_m = some_depths(dataset)
    settings = _with_reach(_with_sigma(_with_origin(settings, dataset), dataset), dataset, depths_m)
    settings = _with_floor(_with_pass_through(settings, dataset), dataset, depths_m)
    return _with_voxel_size(settings, dataset, depths_m)


def _with_origin(settings: Config, dataset: Dataset) -> Config:
    """The recording's origin; a box that is given in the recorded world moves with it."""
    origin, volume = dataset.origin_m, settings.volume
    by_m = origin - volume.origin
    if not by_m.any():
        return settings
    lower, upper = ((None if c is None else tuple((c - by_m).tolist())) for c in (volume.lower, volume.upper))
    volume = replace(volume, origin=tuple(origin.tolist()), lower=lower, upper=upper)
    return replace(settings, volume=volume)


def _with_sigma(settings: Config, dataset: Dataset) -> Config:
    own, sensor = dataset.stated.sigma, settings.sensor
    if own is None or sensor.sigma == own:
        return settings
    text, origin = ", ".join(f"{value:.4g}" for value in own), dataset.stated.origin
    assumed = SensorConfig().sigma, load(shipped_configs()[RIG]).sensor.sigma
    if sensor.sigma_table is not None or sensor.sigma not in assumed:
        dataset.notes.append(f"sensor.sigma is set, so [{text}], {origin}, is not used")
        return _for_all_pixels(settings, dataset)
    dataset.notes.append(f"sensor.sigma is [{text}], {origin}; setting sensor.sigma overrides it")
    return replace(settings, sensor=replace(sensor, sigma=own))


def with_tuned_noise(settings: Config, dataset: Dataset) -> Config:
    """The recording's settings for whoever tries other values of ``sensor.sigma``, which then is that of all
    pixels, and of ``inference.outlier_floor``, which then is set."""
    settings = _for_all_pixels(with_recorded_noise(settings, dataset), dataset)
    return _with_outliers(settings, settings.inference.floor)


def _for_all_pixels(settings: Config, dataset: Dataset) -> Config:
    if not (dataset.stated.pixel_sigma and settings.sensor.pixel_sigma):
        return settings
    dataset.notes.append("sensor.pixel_sigma is false: sensor.sigma applies to all pixels of these frames")
    return replace(settings, sensor=replace(settings.sensor, pixel_sigma=False))


def _with_reach(settings: Config, dataset: Dataset, depths_m: NDArray[np.float32]) -> Config:
    sensor, own = settings.sensor, dataset.stated.reach_m
    given = sensor.max_depth != SensorConfig().max_depth
    if own is not None and not given:
        return _reaching(settings, dataset, own, "as far as the first scan reaches")
    dataset.notes += note_of_filling(depths_m)
    beyond = float((depths_m > sensor.max_depth).mean()) if depths_m.size else 0.0
    useful = _useful_depth(sensor, depths_m)
    if beyond <= MUCH or useful == sensor.max_depth:
        return settings
    if not given:
        return _reaching(settings, dataset, useful, f"up to which sigma is at most {USEFUL:.0%} of depth")
    dataset.notes.append(
        f"{beyond:.0%} of the measurements lie beyond sensor.max_depth, {sensor.max_depth:g} m, and show "
        f"only free space: --sensor.max-depth {useful:g} uses those whose sigma is useful"
    )
    return settings


def _reaching(settings: Config, dataset: Dataset, reach_m: float, why: str) -> Config:
    if reach_m == settings.sensor.max_depth:
        return settings
    note = f"sensor.max_depth is {reach_m:g} m, {why}; setting sensor.max_depth overrides it"
    dataset.notes.append(note)
    return replace(settings, sensor=replace(settings.sensor, max_depth=reach_m))


def some_depths(dataset: Dataset) -> NDArray[np.float32]:
    """The measured depths of a few frames, (n,) metres; none of a camera, whose frames are read only once."""
    depths = [np.zeros(0, np.float32)]
    last = len(dataset) - 1 if not dataset.endless else -1
    for index in sorted(set(np.linspace(0, last, LOOKED_AT).astype(int).tolist())) if last >= 0 else []:
        try:
            depth_m = dataset.read(index).depth_m
        except (FrameError, BackendError):  # a broken frame; one to be rendered before Taichi runs
            continue
        depths.append(depth_m[np.isfinite(depth_m) & (depth_m > 0)])
    return np.concatenate(depths)


def note_of_filling(depths_m: NDArray[np.floating]) -> list[str]:
    """A note, if many measurements are one number that is far larger than all others."""
    if not depths_m.size:
        return []
    largest, others = float(depths_m.max()), depths_m[depths_m < depths_m.max()]
    share = 1 - len(others) / len(depths_m)
    if share < FILLED or not len(others) or others.max() > FARTHEST_OTHER * largest:
        return []
    return [
        f"depth: {share:.0%} of the measurements are exactly {largest:g} m, and no other is farther than "
        f"{others.max():.3g} m: if that stands for what was not seen, write 0 in its place"
    ]


def _useful_depth(sensor: SensorConfig, depths_m: NDArray[np.float32]) -> float:
    """Depth, in whole metres and no less than the default, at which measurements end but for a hundredth, or
    sigma gets too large."""
    least = SensorConfig().max_depth
    most = min(float(np.quantile(depths_m, 0.99)), FARTHEST_M) if depths_m.size else least
    tried = np.arange(least, max(most, least) + 0.5, 0.5)
    sigma = np.median(curves_of(sensor)(tried)[0], axis=0)
    worse = np.flatnonzero(sigma > USEFUL * tried)
    return float(np.rint(tried[max(0, worse[0] - 1)] if len(worse) else tried[-1]))


def proposed_voxel_size(dataset: Dataset) -> float:
    """The voxel size in metres that fits a recording's depths and the noise that it states."""
    return _fitting_voxel_m(dataset, _median_m(some_depths(dataset)))


def _median_m(depths_m: NDArray[np.float32]) -> float:
    return float(np.median(depths_m)) if depths_m.size else 0.0


def _fitting_voxel_m(dataset: Dataset, median_m: float) -> float:
    """5 cm, or the next of 1, 2, 5, 10, 20, ... cm with which a voxel at the median depth is neither finer
    than sigma or a hundredth of the depth, nor coarser than a tenth of it."""
    usual = Config().voxel_size
    if median_m == 0:  # nothing is known
        return usual
    sigma_m = 0.0 if dataset.stated.sigma is None else float(np.polyval(dataset.stated.sigma[::-1], median_m))
    finest, coarsest = max(FINEST * median_m, sigma_m), COARSEST * median_m
    sizes = [digit * 10.0**power for power in range(-4, 3) for digit in (1, 2, 5)]
    if coarsest < usual:
        return max((size for size in sizes if size <= coarsest), default=sizes[0])
    return max(usual, next((size for size in sizes if size >= min(finest, coarsest)), sizes[-1]))


def _with_voxel_size(settings: Config, dataset: Dataset, depths_m: NDArray[np.float32]) -> Config:
    median_m, size = _median_m(depths_m), settings.voxel_size
    fitting = _fitting_voxel_m(dataset, median_m)
    if settings.fit_voxel_size:
        if fitting != size:
            why = f"half of the measured depths are more than {median_m:.2g} m"
            dataset.notes.append(f"voxel_size is {fitting:g} m, since {why}; --voxel-size overrides it")
        return replace(settings, voxel_size=fitting, fit_voxel_size=False)
    if median_m and size > ABSURD * median_m:
        meant = next((f"{size:g}{unit}" for unit, per_m in _UNITS if size / per_m <= COARSEST * median_m), "")
        asked = f": was {meant} meant?" if meant else ";"
        raise ConfigError(
            f"voxel_size is {size:g} m, more than half the median depth of {dataset.name}, {median_m:.2g} m"
            f"{asked} --voxel-size {100 * fitting:g}cm fits"
        )
    return settings


def _with_floor(settings: Config, dataset: Dataset, depths_m: NDArray[np.float32]) -> Config:
    given, reach_m = settings.inference, settings.sensor.max_depth
    if given.outlier_floor is not None:
        return settings
    short = dataset.stated.pass_through is None and reach_m <= SensorConfig().max_depth
    if short and depths_m.size:
        short = float(np.minimum(depths_m, reach_m).mean()) * given.surface_density <= LONG_RAY
    return _with_outliers(settings, SHORT_RAYS_FLOOR) if short else settings


def _with_outliers(settings: Config, per_m: float) -> Config:
    changed: dict[str, Any] = {"inference": replace(settings.inference, outlier_floor=per_m)}
    return replace(settings, **changed)


def _with_pass_through(settings: Config, dataset: Dataset) -> Config:
    own = dataset.stated.pass_through
    if own is None:
        return settings
    for method in METHODS.values():  # all of them: the tuning page may change to another
        section = getattr(settings, method.section)
        if getattr(section, "pass_through", own) is not None:
            continue
        name = f"{method.section}.pass_through"
        if method.name == settings.method:
            dataset.notes.append(f"{name} is {own:g}, {dataset.stated.origin}; setting {name} overrides it")
        changed: dict[str, Any] = {method.section: replace(section, pass_through=own)}
        settings = replace(settings, **changed)
    return settings
