"""The noise of depth that a recording itself gives, as a stereo calibration does, put into the parameters."""

from dataclasses import replace

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.datasets.base import Dataset


def with_recorded_noise(settings: Config, dataset: Dataset) -> Config:
    """The parameters with the recording's own sigma in place of the default; adds a note to the dataset.

    A sigma or a sigma table that the user has set stays.
    """
    own, sensor = dataset.recorded_sigma, settings.sensor
    if own is None or sensor.sigma == own:
        return settings
    text = ", ".join(f"{value:.4g}" for value in own)
    if sensor.sigma_table is not None or sensor.sigma != SensorConfig().sigma:
        dataset.notes.append(f"sensor.sigma is set, so the recording's own sigma, [{text}], is not used")
        return settings
    dataset.notes.append(f"sensor.sigma is [{text}], the recording's own; setting sensor.sigma overrides it")
    return replace(settings, sensor=replace(sensor, sigma=own))
