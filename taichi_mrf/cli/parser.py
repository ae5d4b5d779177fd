"""From the words of the command line to the options of a command, and the overview of all commands."""

import contextlib
import dataclasses
import inspect
import io
import itertools
import re
import shutil
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from functools import partial, reduce
from operator import or_
from typing import Annotated, Any, Literal

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from taichi_mrf.calibration import options as calibration_options
from taichi_mrf.cli.commands import COMMANDS, Command
from taichi_mrf.cli.shared.terminal import PROGRAM
from taichi_mrf.config import schema as config
from taichi_mrf.config import sections
from taichi_mrf.config.gone import note_gone
from taichi_mrf.config.text import field_help
from taichi_mrf.config.values import LENGTHS, has_flag, is_in_files, metres, nearest
from taichi_mrf.errors import ConfigError
from taichi_mrf.factor_graph import config as factor_graph_config

DEFINITIONS = (
    config.__name__,
    sections.__name__,
    calibration_options.__name__,
    factor_graph_config.__name__,
)
"""The modules whose dataclasses are parameters."""

registry = ConstructorRegistry()
"""For :func:`tyro.cli`, which by itself keeps the line breaks that the source code has in a help text."""

_HELP, _HELP_ALL = ("-h", "--help"), "--help-all"
_ABOUT = "Probabilistic occupancy maps from depth cameras."
_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")
_INDENT = 26
_WIDEST = 100
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT"}


def parse(arguments: Sequence[str]) -> tuple[Command, Any]:
    """The command that the arguments name, and its options.

    Help ends the program with status 0. Raises ConfigError for an unknown command, for arguments that cannot
    be parsed, and for values that are out of range.
    """
    if arguments and arguments[0] in _COMPLETION:
        _print_completion(arguments)
    if not arguments or arguments[0] in _HELP:
        print(overview())
        raise SystemExit(0 if arguments else 2)
    name, *rest = arguments
    if name not in COMMANDS:
        raise ConfigError(f"unknown command '{name}'; {nearest(name, list(COMMANDS))}")
    command, program = COMMANDS[name], f"{PROGRAM} {name}"
    if {*_HELP, _HELP_ALL} & set(rest):
        print(help_text(program, command.options, () if _HELP_ALL in rest else command.brief))
        raise SystemExit(0)
    rest = list(_in_metres(rest))
    _refuse_unknown_flags(program, command, rest)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            default = command.defaults(rest)
            options = tyro.cli(command.options, prog=program, args=rest, default=default, registry=registry)
    except SystemExit:
        problem = in_one_line(box.getvalue())
        example = f", such as {command.example}" if command.example and problem.startswith("missing") else ""
        raise ConfigError(f"{name}: {problem}{example}; '{program} --help' explains") from None
    return command, options


def _in_metres(arguments: Sequence[str]) -> Iterator[str]:
    """The arguments, with lengths that have a unit as numbers of metres."""
    flag = ""
    for word in arguments:
        name, equals, value = word.partition("=")
        flag = name.strip("-").replace("-", "_") if word.startswith("--") else flag
        if flag not in LENGTHS or (word.startswith("--") and not equals):
            yield word
        else:
            yield f"{name}={metres(value)}" if equals else metres(word)


def in_one_line(box: str) -> str:
    """Message of tyro from a box of several lines about arguments: the first part, without the frame."""
    is_rule = re.compile(r"\s*[-─╰]{5,}").match
    lines = [line.strip("│").rstrip() for line in box.splitlines()[1:]]  # the first is a title
    first = itertools.takewhile(lambda line: not is_rule(line), itertools.dropwhile(is_rule, lines))
    said = textwrap.dedent("\n".join(first)).splitlines()
    if said and said[0].startswith("Missing from"):  # each with its help, further to the right
        return "missing " + ", ".join(line.strip() for line in said if re.match(r" {4}\S", line))
    text = " ".join(" ".join(said).split()).rstrip(".")
    return text[:1].lower() + text[1:]


def _refuse_unknown_flags(program: str, command: Command, arguments: Sequence[str]) -> None:
    """Raise ConfigError for a flag that the command does not have; the text names the nearest that it has."""
    known = [name for flag in flags_of(command.options) for name in (flag.name, flag.negative) if name]
    for word in arguments:
        flag = word.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known:
            near = get_close_matches(flag, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"'{program} {_HELP_ALL}' explains all flags"
            if "--config" in known:
                hint = _set_elsewhere(flag) or hint
            raise ConfigError(f"{program.removeprefix(PROGRAM).strip()}: unknown flag {flag}; {hint}")


def _set_elsewhere(flag: str) -> str:
    """Place where a mapping parameter without a flag is set, or what became of it; "" for all other flags."""
    owner: Any = config.Config
    flagged = filed = True
    path = flag.removeprefix("--").replace("-", "_")
    for name in path.split("."):
        fields = {field.name: field for field in dataclasses.fields(owner)}
        if name not in fields:
            return note_gone(owner.__name__, name, None) or ""
        flagged, filed = flagged and has_flag(fields[name]), filed and is_in_files(fields[name])
        hint = typing.get_type_hints(owner)[name]
        if not dataclasses.is_dataclass(hint):
            in_python = f"it is set in Python, {owner.__name__}({name}=...)"
            return "" if flagged else f"set {path} in the file of --config" if filed else in_python
        owner = hint
    return ""


def overview() -> str:
    """Overview of the program: what it is, and every command with the first sentence of its help."""
    width = max(map(len, COMMANDS))
    lines = [f"usage: {PROGRAM} COMMAND ...", "", _ABOUT, "", "commands:"]
    lines += [f"  {name:{width}}  {_first_sentence(command.options)}" for name, command in COMMANDS.items()]
    lines += ["", f"'{PROGRAM} COMMAND --help' explains a command, '{PROGRAM} --version' names the version."]
    return "\n".join(lines)


def _first_sentence(options: type) -> str:
    text = " ".join((inspect.getdoc(options) or "").split())
    return text.partition(". ")[0].rstrip(".")


def _print_completion(arguments: Sequence[str]) -> None:
    """Print what teaches a shell to complete the commands and their flags, and end the program."""
    commands: list[Any] = []
    for name, command in COMMANDS.items():
        default = command.defaults([])
        commands.append(
            Annotated[command.options, tyro.conf.subcommand(name, default=default, prefix_name=False)]
        )
    tyro.cli(reduce(or_, commands), prog=PROGRAM, args=arguments, registry=registry)


@registry.struct_rule
def configuration_flags(info: StructTypeInfo) -> StructConstructorSpec | None:
    """One flag a field that has one for the dataclasses of DEFINITIONS; nothing for any other type."""
    if not (dataclasses.is_dataclass(info.type) and info.type.__module__ in DEFINITIONS):
        return None
    hints, texts = typing.get_type_hints(info.type), field_help(info.type)
    defaults = info.default if isinstance(info.default, info.type) else info.type()
    fields = (
        StructFieldSpec(field.name, hints[field.name], getattr(defaults, field.name), texts[field.name])
        for field in filter(has_flag, dataclasses.fields(info.type))
    )
    return StructConstructorSpec(partial(dataclasses.replace, defaults), tuple(fields))


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
        metavar = given.metavar if given is not None and given.metavar else field.metadata.get("metavar")
        metavar = metavar or _metavar(hint)
        if tyro.conf.Positional in metadata:
            yield Flag(metavar, "", texts.get(field.name, ""), field.default)
            continue
        word = (prefix + name).replace("_", "-")
        head, dot, tail = word.rpartition(".")
        off = f"--{head}{dot}no-{tail}" if hint is bool else None
        if off and alone:  # the one of the pair that changes the default
            word, off = (off[2:] if field.default is True else word), None
        yield Flag(f"--{word}", metavar, texts.get(field.name, ""), field.default, off)


def help_text(program: str, options: type, brief: Sequence[str] = ()) -> str:
    """The usage, what the command does, its arguments and flags, or those of them that ``brief`` names."""
    flags = list(flags_of(options))
    by_name = {flag.name: flag for flag in flags}
    shown = [flag for flag in flags if flag.positional]
    shown += [by_name[f"--{name}"] for name in brief] if brief else [f for f in flags if not f.positional]
    needed = [flag for flag in shown if flag.positional or flag.default is dataclasses.MISSING]
    usage = [f.shown() if f.default is dataclasses.MISSING else f"[{f.shown()}]" for f in needed]
    width = min(_WIDEST, shutil.get_terminal_size().columns)
    lines = [" ".join(["usage:", program, *usage, "[FLAGS]"]), ""]
    for paragraph in (textwrap.dedent(f"    {options.__doc__}")).split("\n\n"):
        lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""]
    for flag in shown:
        lines += _flag_entry(flag, width)
    if brief:
        count = sum(not flag.positional for flag in flags)
        lines += ["", f"'{program} --help-all' explains all {count} flags."]
    return "\n".join(lines)


def _flag_entry(flag: Flag, width: int) -> list[str]:
    """One flag with its help beside it, or below it if the flag is long."""
    plain = flag.help.replace("``", "").replace("`", "")  # a terminal has no type for code
    text = textwrap.wrap(plain + _default_words(flag), width - _INDENT)
    first = f"  {flag.shown()}"
    if len(first) + 2 > _INDENT:
        return [first, *(" " * _INDENT + line for line in text)]
    return [f"{first:{_INDENT}}{text[0]}", *(" " * _INDENT + line for line in text[1:])]


def _default_words(flag: Flag) -> str:
    default = flag.default
    if default in (None, False, dataclasses.MISSING, "", ()):
        return " (required)" if default is dataclasses.MISSING else ""
    if default is True:  # a flag that switches off says by its name what is on
        return " (default: on)" if flag.negative else ""
    return f" (default: {' '.join(map(str, default)) if isinstance(default, tuple) else default})"


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
