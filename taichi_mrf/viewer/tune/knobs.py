"""Which parameters can be tuned on the page, and how far: the one list of sliders, boxes and search ranges.

What a parameter is called, means and accepts stands in config.py; here is only what a slider needs beside
that.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from taichi_mrf.config.schema import Config
from taichi_mrf.viewer.ranges import Range
from taichi_mrf.viewer.tune.parameters import Parameter, find_parameter

Section = Literal["map", "inference", "log_odds", "visibility", "keyframes", "sensor"]


@dataclass(frozen=True)
class Knob:
    """A parameter with the range of its slider, None for a choice or a switch, and its unit.

    With ``decades`` the slider stands for the power of ten, and so does the range.
    """

    name: str
    section: Section
    range: Range | None = None
    unit: str = ""
    decades: bool = False

    @cached_property
    def parameter(self) -> Parameter:
        """The parameter in the configuration."""
        return find_parameter(self.name)

    @property
    def label(self) -> str:
        """How the widget is called."""
        parameter = self.parameter
        text = parameter.path[-1].replace("_", " ").capitalize()
        if parameter.coefficient is not None:
            text += f" · {('1', 'z', 'z²', 'z³', 'z⁴')[parameter.coefficient]}"
        unit = f"10^x {self.unit}".strip() if self.decades else self.unit
        return f"{text} ({unit})" if unit else text

    def applies(self, config: Config) -> bool:
        """Whether the parameter changes anything under this configuration."""
        methods: dict[Section, str] = {"inference": "mrf", "log_odds": "log_odds", "visibility": "visibility"}
        if methods.get(self.section, config.method) != config.method:
            return False
        sensor, inference = config.sensor, config.inference
        hidden = {
            "inference.surface_density": inference.prior is not None,
            "inference.prior": inference.prior is None,
        }
        if self.name.startswith("sensor.sigma["):
            return sensor.sigma_table is None
        if self.name.startswith("sensor.bias["):
            return sensor.bias_table is None
        return not hidden.get(self.name, False)

    def value_of(self, config: Config) -> Any:
        """The parameter's value."""
        return self.parameter.value_of(config)


KNOBS = (
    Knob("method", "map"),
    Knob("voxel_size", "map", Range(0.02, 0.2, 0.005), "m"),
    Knob("inference.method", "inference"),
    Knob("inference.surface_density", "inference", Range(0.1, 12.0, 0.1), "per m"),
    Knob("inference.prior", "inference", Range(0.005, 0.6, 0.005)),
    Knob("inference.sweeps", "inference", Range(1, 6, 1)),
    Knob("inference.likelihood", "inference"),
    Knob("inference.outlier_floor", "inference", Range(-9.0, 0.0, 0.25), "per m", decades=True),
    Knob("inference.message_clamp", "inference", Range(0.5, 14.0, 0.1), "log-odds"),
    Knob("inference.cavity_clamp", "inference", Range(0.5, 20.0, 0.1), "log-odds"),
    Knob("inference.free_share", "inference", Range(0.0, 1.0, 0.01)),
    Knob("inference.ray_density", "inference", Range(0.0, 10.0, 0.5), "per cm"),
    Knob("log_odds.hit", "log_odds", Range(0.51, 0.98, 0.01)),
    Knob("log_odds.miss", "log_odds", Range(0.02, 0.49, 0.01)),
    Knob("log_odds.lowest", "log_odds", Range(0.01, 0.49, 0.01)),
    Knob("log_odds.highest", "log_odds", Range(0.51, 0.99, 0.01)),
    Knob("log_odds.update", "log_odds"),
    Knob("log_odds.correct_bias", "log_odds"),
    Knob("visibility.hit_if_free", "visibility", Range(0.02, 0.98, 0.01)),
    Knob("visibility.hit_if_occupied", "visibility", Range(0.02, 0.98, 0.01)),
    Knob("visibility.hit_if_hidden", "visibility", Range(0.01, 0.98, 0.01)),
    Knob("visibility.visible_if_occluded", "visibility", Range(0.0, 1.0, 0.01)),
    Knob("keyframes.rotation", "keyframes", Range(0.0, 1.0, 0.01), "rad"),
    Knob("keyframes.translation", "keyframes", Range(0.0, 2.0, 0.02), "m"),
    Knob("keyframes.against", "keyframes"),
    Knob("sensor.sigma[0]", "sensor", Range(0.0, 0.1, 0.0005), "m"),
    Knob("sensor.sigma[1]", "sensor", Range(-0.05, 0.05, 0.0005)),
    Knob("sensor.sigma[2]", "sensor", Range(-0.01, 0.05, 0.0001), "per m"),
    Knob("sensor.bias[0]", "sensor", Range(-0.1, 0.1, 0.0005), "m"),
    Knob("sensor.bias[1]", "sensor", Range(-0.05, 0.05, 0.0005)),
    Knob("sensor.bias[2]", "sensor", Range(-0.02, 0.02, 0.0005), "per m"),
)
"""In the order of the page. Every method's own section is shown only while that method is chosen."""
