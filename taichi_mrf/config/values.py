"""Values of parameters: the places where each can be set, and typed dataclasses made from the plain values of
YAML or of a caller.

A dataclass is the only definition of its parameters' names and types. A value that does not fit raises a
ConfigError, which names the place and, for an unknown name, the nearest known one.
"""

import dataclasses
import difflib
import numbers
import reprlib
import types
import typing
import warnings
from collections.abc import Sequence
from typing import Any, Literal, TypeVar, cast

from taichi_mrf.errors import ArgumentTypeError, ConfigError

T = TypeVar("T")

IN_FILES, IN_PYTHON = {"flag": False}, {"flag": False, "file": False}
"""Metadata of fields without a flag, and of fields that only Python sets."""


def in_files(default: T) -> T:
    """A field that has no flag: a file sets it (--config)."""
    return cast(T, dataclasses.field(default=default, metadata=IN_FILES))


def in_python(default: T) -> T:
    """A field that only Python sets. Map files hold it too."""
    return cast(T, dataclasses.field(default=default, metadata=IN_PYTHON))


def has_flag(field: "dataclasses.Field[Any]") -> bool:
    """True if a command has a flag for a field, or flags for its fields."""
    return bool(field.metadata.get("flag", True))


def is_in_files(field: "dataclasses.Field[Any]") -> bool:
    """True if a file of parameters may set a field."""
    return bool(field.metadata.get("file", True))


LENGTHS = ("voxel_size", "voxel_sizes", "submap_size", "cell_size")
"""The parameters, flags among them, that may be stated with a unit: 5cm."""

_UNITS_M = {"mm": 1000, "cm": 100, "m": 1}


def metres(text: str) -> str:
    """A length with a unit, such as 5cm or 50 mm, as a number of metres; any other text as it stands."""
    number = text.rstrip().rstrip("cm")
    per_m = _UNITS_M.get(text.rstrip()[len(number) :])
    try:
        return text if per_m is None else repr(float(number) / per_m)
    except ValueError:
        return text


_LARGEST = 2**63 - 1


def unknown_key(key: object, known: typing.Iterable[str], where: str) -> ConfigError:
    """The error for a parameter that does not exist: it names the nearest one that does."""
    hint = nearest(str(key)[:100], list(known))
    return ConfigError(f"{where}: unknown parameter {shown(key)}; {hint}")


def nearest(name: str, known: Sequence[str]) -> str:
    """A hint for an unknown name: the most similar known one, or all of them."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean '{near[0]}'?" if near else f"known are: {', '.join(known)}"


def overridden(config: T, overrides: dict[str, Any], where: str) -> T:
    """A dataclass instance with some fields replaced. Raises ConfigError for an unknown name or a value of
    the wrong type."""
    names = [f.name for f in dataclasses.fields(config)]  # type: ignore[arg-type]
    for key, value in overrides.items():
        if key not in names:
            from taichi_mrf.config.gone import note_gone  # loaded for those who need it

            note = note_gone(type(config).__name__, key, value)
            raise ConfigError(f"{where}: {note}") if note else unknown_key(key, names, where)
    hints = typing.get_type_hints(type(config))
    values = {}
    for key, value in overrides.items():
        if isinstance(value, str) and float in (hints[key], *typing.get_args(hints[key])):
            raise ArgumentTypeError(f"{where}: {key} must be a number, not {shown(value)}")
        values[key] = _convert(value, hints[key], f"{where}: {key}")
    return dataclasses.replace(config, **values)  # type: ignore[type-var]


def shown(value: Any) -> str:
    """A value as an error shows it: shortened if it is long."""
    return _SHORT.repr(value)


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 100


def from_dict(cls: type[T], values: Any, where: str, of_map: bool = False) -> T:
    """Build a configuration dataclass from parsed YAML.

    ``where`` is the file, for error messages. Raises ConfigError for an unknown key (naming the nearest), a
    removed parameter that is not at its former default (saying what became of it), a value of the wrong type,
    or one outside its range. The parameters ``of_map`` are those with which a map was made, by whatever
    version: removed ones are left out with a warning.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: expected a mapping of parameters, not {shown(values)}")
    hints = typing.get_type_hints(cls)
    arguments = {}
    for key, value in values.items():
        if key not in hints:
            from taichi_mrf.config.gone import note_gone

            note = note_gone(cls.__name__, str(key), value)
            if note is None:
                raise unknown_key(key, hints, where)
            if note and not of_map:
                raise ConfigError(f"{where}: {note}; remove it")
            if note:
                warnings.warn(f"{where}: {note}", stacklevel=2)
            continue
        plain = metres(value) if key in LENGTHS and isinstance(value, str) else value
        arguments[key] = _convert(plain, hints[key], f"{where}: {key}", of_map)
    missing = [
        field.name
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        if field.name not in arguments and field.default is field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{where}: {', '.join(missing)} missing")
    try:
        return cls(**arguments)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def check_files_set_it(config: Any, where: str, in_files: bool = True) -> None:
    """Raise ConfigError for a value of a dataclass read from a file that only Python sets. Its default is let
    pass, because files of earlier versions hold it."""
    for field in dataclasses.fields(config):
        value, allowed = getattr(config, field.name), in_files and is_in_files(field)
        if dataclasses.is_dataclass(value):
            check_files_set_it(value, f"{where}: {field.name}", allowed)
        elif not allowed and value != field.default:
            instead = f"set it in Python, {type(config).__name__}({field.name}={value!r}), or remove it"
            raise ConfigError(f"{where}: {field.name} is not read from files; {instead}")


def _convert(value: Any, hint: Any, where: str, of_map: bool = False) -> Any:
    """Convert one value to a field's type. Whole numbers are accepted for float, numbers of NumPy for
    both. ``of_map`` as in :func:`from_dict`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, where, of_map)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(value, next(a for a in arguments if a is not type(None)), where)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{where} must be one of {', '.join(map(str, arguments))}, not {shown(value)}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where} must be a list, not {shown(value)}")
        if arguments[-1] is not Ellipsis and len(value) != len(arguments):
            raise ConfigError(f"{where} must have {len(arguments)} entries, not {len(value)}")
        return tuple(_convert(v, arguments[0], where) for v in value)
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 1e-6 (without a point) as a string
        try:
            value = float(value)
        except ValueError:
            raise ConfigError(f"{where} must be a number, not {shown(value)}") from None
    if hint in (int, float) and isinstance(value, numbers.Real) and not isinstance(value, bool):
        value = int(value) if isinstance(value, numbers.Integral) else float(value)  # from NumPy's types
    if isinstance(value, int | float) and _LARGEST < abs(value) < float("inf"):  # a distance may be infinite
        raise ConfigError(f"{where} is too large a number: {shown(value)}")
    accepted = (int, float) if hint is float else hint
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{where} must be of type {hint.__name__}, not {shown(value)}")
    return float(value) if hint is float else value


def check_field(ok: bool, name: str, problem: str) -> None:
    """Raise ConfigError, which names the field, unless ``ok``."""
    if not ok:
        raise ConfigError(f"{name} {problem}")
