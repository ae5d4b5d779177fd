"""Which parameters can be tuned on the page, and how far: those that all methods share, and each method's own
sliders from its entry.

A parameter's name, meaning and limits are the configuration's; here is only what a slider needs beside that.
A name is the way through the nested dataclasses, ``inference.sweeps``, and may end in the number of a
coefficient, ``sensor.sigma[1]``, ascending powers of depth.
"""

import dataclasses
import re
import typing
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

from taichi_mrf.config.method import Method, Range, Slider, always
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import field_help
from taichi_mrf.config.values import unknown_key
from taichi_mrf.errors import ConfigError

_NAME = re.compile(r"([a-z_]+(?:\.[a-z_]+)*)(?:\[(\d)\])?")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """Place of a parameter: the ``path`` of fields, and which coefficient of a polynomial, None for a single
    value. ``hint`` is the type of one value, ``help`` the field's docstring."""

    name: str
    path: tuple[str, ...]
    coefficient: int | None
    hint: Any
    help: str

    def value_of(self, config: Config) -> Any:
        """Value of the parameter; a coefficient beyond the polynomial's last is 0."""
        value: Any = attrgetter(".".join(self.path))(config)
        if self.coefficient is None:
            return value
        return value[self.coefficient] if self.coefficient < len(value) else 0.0

    def replaced(self, config: Config, value: Any) -> Config:
        """The configuration with another value. Raises ConfigError for one out of its range."""
        if self.coefficient is not None:
            whole = dataclasses.replace(self, coefficient=None).value_of(config)
            terms = [*whole, *[0.0] * (self.coefficient + 1 - len(whole))]
            terms[self.coefficient] = value
            value = tuple(terms)
        changed: Config = _replaced(config, self.path, value)
        return changed


def find_parameter(name: str) -> Parameter:
    """The parameter of this name. Raises ConfigError, which names the nearest one, if there is none."""
    match = _NAME.fullmatch(name)
    if match is None:
        raise ConfigError(f"'{name}' is no parameter's name; names look like inference.sweeps")
    path = tuple(match[1].split("."))
    owner: Any = Config
    for depth, field in enumerate(path):
        hints = typing.get_type_hints(owner)
        if field not in hints:
            raise unknown_key(field, hints, ".".join(path[:depth]) or "parameters")
        last, hint = owner, hints[field]
        is_section = dataclasses.is_dataclass(hint)
        if is_section == (depth == len(path) - 1):
            raise ConfigError(f"{name}: {field} is {'a section' if is_section else 'no section'}")
        owner = hint
    is_tuple = typing.get_origin(hint) is tuple
    if is_tuple != (match[2] is not None):
        asked = f"name one of its coefficients, {name}[0]" if is_tuple else f"{match[1]} has no coefficients"
        raise ConfigError(f"{name}: {asked}")
    coefficient = None if match[2] is None else int(match[2])
    value_hint = typing.get_args(hint)[0] if is_tuple else hint
    return Parameter(name, path, coefficient, value_hint, field_help(last)[path[-1]])


def _replaced(section: Any, path: tuple[str, ...], value: Any) -> Any:
    if len(path) > 1:
        value = _replaced(getattr(section, path[0]), path[1:], value)
    return dataclasses.replace(section, **{path[0]: value})


@dataclass(frozen=True)
class Knob:
    """A parameter with the range of its slider, None for a choice or a switch, and its unit.

    With ``decades`` the slider shows the power of ten, and so does the range. ``method`` is the only one that
    reads the parameter, None if all do; ``counts`` says whether it changes anything under a configuration of
    that method. ``by_factors`` and ``searched`` are for the automatic search (config.method.Slider).
    """

    name: str
    section: str
    range: Range | None = None
    unit: str = ""
    decades: bool = False
    method: str | None = None
    counts: Callable[[Config], bool] = always
    by_factors: bool = False
    searched: bool = False

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
        """True if the parameter changes anything under this configuration."""
        return self.method in (None, config.method) and self.counts(config)


def _knobs_of(method: Method) -> list[Knob]:
    """A method's sliders, which name fields of its section."""

    def counts(slider: Slider) -> Callable[[Config], bool]:
        return lambda config: slider.counts(getattr(config, method.section))

    return [
        Knob(
            f"{method.section}.{slider.name}",
            method.section,
            slider.range,
            slider.unit,
            slider.decades,
            method.name,
            counts(slider),
            slider.by_factors,
            slider.searched,
        )
        for slider in method.sliders
    ]


def _has_no_table(of: str) -> Callable[[Config], bool]:
    return lambda config: getattr(config.sensor, f"{of}_table") is None


KNOBS = (
    Knob("method", "map"),
    Knob("voxel_size", "map", Range(0.02, 0.2, 0.005), "m", by_factors=True),
    *(knob for method in METHODS.values() for knob in _knobs_of(method)),
    Knob("keyframes.rotation", "keyframes", Range(0.0, 1.0, 0.01), "rad"),
    Knob("keyframes.translation", "keyframes", Range(0.0, 2.0, 0.02), "m"),
    Knob("sensor.sigma[0]", "sensor", Range(0.0, 0.1, 0.0005), "m", counts=_has_no_table("sigma")),
    Knob("sensor.sigma[1]", "sensor", Range(-0.05, 0.05, 0.0005), counts=_has_no_table("sigma")),
    Knob("sensor.sigma[2]", "sensor", Range(-0.01, 0.05, 0.0001), "per m", counts=_has_no_table("sigma")),
    Knob("sensor.bias[0]", "sensor", Range(-0.1, 0.1, 0.0005), "m", counts=_has_no_table("bias")),
    Knob("sensor.bias[1]", "sensor", Range(-0.05, 0.05, 0.0005), counts=_has_no_table("bias")),
    Knob("sensor.bias[2]", "sensor", Range(-0.02, 0.02, 0.0005), "per m", counts=_has_no_table("bias")),
)
"""In the order of the page. A method's own section is shown only while that method is chosen."""
