"""The flags of a command, read from the dataclass of its options: for the short help and for suggestions."""

import dataclasses
import shutil
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

import tyro

from taichi_mrf.config.places import has_flag
from taichi_mrf.config.text import field_help

_INDENT = 26
_WIDEST = 100
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT"}


@dataclasses.dataclass(frozen=True)
class Flag:
    """One flag or positional argument: its name as it is typed, what follows it, its help, its default."""

    name: str
    metavar: str
    help: str
    default: Any
    negative: str | None = None
    """The flag that switches it off, if there is one."""

    @property
    def positional(self) -> bool:
        """True if it is an argument without a name."""
        return not self.name.startswith("--")

    def shown(self) -> str:
        """The flag with what follows it."""
        names = self.name if self.negative is None else f"{self.name}, {self.negative}"
        return f"{names} {self.metavar}".rstrip()


def flags_of(options: type, prefix: str = "", pairs_off: bool = False) -> Iterator[Flag]:
    """Every flag of an options dataclass, those of nested dataclasses included, in the order of the help."""
    hints = typing.get_type_hints(options, include_extras=True)
    texts = field_help(options)
    for field in filter(has_flag, dataclasses.fields(options)):
        hint: Any = hints[field.name]
        metadata: Sequence[Any] = ()
        if typing.get_origin(hint) is Annotated:
            hint, *metadata = typing.get_args(hint)
        given: Any = next((each for each in metadata if hasattr(each, "metavar")), None)
        name = field.name if given is None or given.name is None else given.name
        alone = pairs_off or tyro.conf.FlagCreatePairsOff in metadata
        if dataclasses.is_dataclass(hint):
            yield from flags_of(typing.cast(type, hint), f"{prefix}{name}." if name else prefix, alone)
            continue
        metavar = given.metavar if given is not None and given.metavar else _metavar(hint)
        if tyro.conf.Positional in metadata:
            yield Flag(metavar, "", texts.get(field.name, ""), field.default)
            continue
        word = (prefix + name).replace("_", "-")
        head, dot, tail = word.rpartition(".")
        off = f"--{head}{dot}no-{tail}" if hint is bool else None
        if off and alone:  # the one of the pair that changes the default
            word, off = (off[2:] if field.default is True else word), None
        yield Flag(f"--{word}", metavar, texts.get(field.name, ""), field.default, off)


def brief_help(program: str, options: type, brief: Sequence[str]) -> str:
    """The usage, what the command does, its arguments and the flags of the given names."""
    flags = list(flags_of(options))
    by_name = {flag.name: flag for flag in flags}
    shown = [flag for flag in flags if flag.positional] + [by_name[f"--{name}"] for name in brief]
    required = [flag.shown() for flag in shown if flag.default is dataclasses.MISSING]
    width = min(_WIDEST, shutil.get_terminal_size().columns)
    lines = [f"usage: {program} {' '.join(required)} [FLAGS]", ""]
    for paragraph in (textwrap.dedent(f"    {options.__doc__}")).split("\n\n"):
        lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""]
    for flag in shown:
        lines += _entry(flag, width)
    lines += ["", f"'{program} --help-all' explains all {sum(not flag.positional for flag in flags)} flags."]
    return "\n".join(lines)


def _entry(flag: Flag, width: int) -> list[str]:
    """One flag with its help beside it, or below it if the flag is long."""
    text = textwrap.wrap(flag.help + _default(flag), width - _INDENT)
    first = f"  {flag.shown()}"
    if len(first) + 2 > _INDENT:
        return [first, *(" " * _INDENT + line for line in text)]
    return [f"{first:{_INDENT}}{text[0]}", *(" " * _INDENT + line for line in text[1:])]


def _default(flag: Flag) -> str:
    if flag.default in (None, False, dataclasses.MISSING, ""):
        return " (required)" if flag.default is dataclasses.MISSING else ""
    return f" (default: {flag.default})"


def _metavar(hint: Any) -> str:
    """Placeholder for the value after a flag of this type."""
    if hint is bool:
        return ""
    if typing.get_origin(hint) is Literal:
        return "{" + ",".join(map(str, typing.get_args(hint))) + "}"
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _metavar(next(each for each in typing.get_args(hint) if each is not type(None)))
    if typing.get_origin(hint) is tuple:
        return _metavar(typing.get_args(hint)[0]) + " ..."
    return _METAVARS.get(hint, "VALUE")
