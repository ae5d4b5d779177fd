"""What a recording itself says of its sensor, put into the parameters: the noise of depth that a stereo
calibration gives, the reach of a lidar, and that its beams pass what fills only a part of a voxel."""

from dataclasses import replace
from typing import Any

from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets.base import Dataset


def with_recorded_noise(settings: Config, dataset: Dataset) -> Config:
    """The parameters with the recording's own sigma, reach and ``pass_through`` in place of the defaults;
    adds notes to the dataset.

    What the user has set stays, and a sigma or sigma table that is set is that of all pixels.
    """
    return _with_pass_through(_with_reach(_with_sigma(settings, dataset), dataset), dataset)


def _with_sigma(settings: Config, dataset: Dataset) -> Config:
    own, sensor = dataset.recorded_sigma, settings.sensor
    if own is None or sensor.sigma == own:
        return settings
    text, origin = ", ".join(f"{value:.4g}" for value in own), dataset.sigma_origin
    if sensor.sigma_table is not None or sensor.sigma != SensorConfig().sigma:
        dataset.notes.append(f"sensor.sigma is set, so [{text}], {origin}, is not used")
        return _for_all_pixels(settings, dataset)
    dataset.notes.append(f"sensor.sigma is [{text}], {origin}; setting sensor.sigma overrides it")
    return replace(settings, sensor=replace(sensor, sigma=own))


def with_tuned_noise(settings: Config, dataset: Dataset) -> Config:
    """The same for whoever tries other values of ``sensor.sigma``, which then is that of all pixels."""
    return _for_all_pixels(with_recorded_noise(settings, dataset), dataset)


def _for_all_pixels(settings: Config, dataset: Dataset) -> Config:
    if not (dataset.states_pixel_sigma and settings.sensor.pixel_sigma):
        return settings
    dataset.notes.append("sensor.pixel_sigma is false: sensor.sigma holds for all pixels of these frames")
    return replace(settings, sensor=replace(settings.sensor, pixel_sigma=False))


def _with_reach(settings: Config, dataset: Dataset) -> Config:
    own, sensor = dataset.recorded_reach, settings.sensor
    if own is None or sensor.max_depth != SensorConfig().max_depth or sensor.max_depth == own:
        return settings
    reach = f"{own:g} m, as far as the first scan reaches"
    dataset.notes.append(f"sensor.max_depth is {reach}; setting sensor.max_depth overrides it")
    return replace(settings, sensor=replace(sensor, max_depth=own))


def _with_pass_through(settings: Config, dataset: Dataset) -> Config:
    own = dataset.recorded_pass_through
    if own is None:
        return settings
    for method in METHODS.values():  # all of them: the tuning page may change to another
        section = getattr(settings, method.section)
        if getattr(section, "pass_through", own) is not None:
            continue
        name = f"{method.section}.pass_through"
        if method.name == settings.method:
            dataset.notes.append(f"{name} is {own:g}, {dataset.sigma_origin}; setting {name} overrides it")
        changed: dict[str, Any] = {method.section: replace(section, pass_through=own)}
        settings = replace(settings, **changed)
    return settings
