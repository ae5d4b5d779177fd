"""One parameter of the configuration, found and replaced by its name.

A name is the way through the nested dataclasses, ``inference.sweeps``, and may end in the number of a
coefficient, ``sensor.sigma[1]``, ascending powers of depth.
"""

import dataclasses
import re
import typing
from typing import Any

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
        value: Any = config
        for field in self.path:
            value = getattr(value, field)
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
