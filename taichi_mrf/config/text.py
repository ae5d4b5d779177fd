"""Configurations as text: the YAML that a run leaves beside its results, each field with its help.

A field's help is the string under it in the source, or its metadata where it is put together from several.
"""

import ast
import dataclasses
import inspect
import textwrap
from functools import cache
from typing import Any

import yaml

from taichi_mrf.config.values import is_in_files

_WIDTH = 100


def field_help(cls: type) -> dict[str, str]:
    """The help text of each field of a configuration dataclass, as one line."""
    texts = {f.name: f.metadata["help"] for f in dataclasses.fields(cls) if "help" in f.metadata}
    for base in cls.__mro__:
        if dataclasses.is_dataclass(base) and not texts.keys() >= base.__annotations__.keys():
            texts |= _docstrings(base)
    return {field.name: texts[field.name] for field in dataclasses.fields(cls) if field.name in texts}


@cache
def _docstrings(cls: type) -> dict[str, str]:
    """The strings under the fields of one class in its source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    assert isinstance(body, ast.ClassDef)
    texts = {}
    for statement, below in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        ):
            texts[statement.target.id] = " ".join(str(below.value.value).split())
    return texts


def commented_yaml(config: Any) -> str:
    """The parameters that a file may set as commented YAML, which reads back unchanged."""
    return "".join(_section(config, ""))


def differences(first: Any, second: Any, prefix: str = "") -> list[str]:
    """Names (such as "sensor.patch") of the fields in which two configurations of one type differ."""
    names: list[str] = []
    for field in dataclasses.fields(first):
        a, b = getattr(first, field.name), getattr(second, field.name)
        if dataclasses.is_dataclass(a):
            names += differences(a, b, f"{prefix}{field.name}.")
        elif a != b:
            names.append(prefix + field.name)
    return names


def _section(section: Any, indent: str) -> list[str]:
    """The lines of one dataclass; nested ones are indented below their names."""
    lines: list[str] = []
    texts = field_help(type(section))
    for field in filter(is_in_files, dataclasses.fields(section)):
        value = getattr(section, field.name)
        lines.append("\n" if lines else "")
        lines += [f"{indent}# {line}\n" for line in textwrap.wrap(texts[field.name], _WIDTH - len(indent))]
        if dataclasses.is_dataclass(value):
            lines += [f"{indent}{field.name}:\n", *_section(value, indent + "  ")]
        else:
            lines.append(f"{indent}{field.name}: {_scalar(value)}\n")
    return lines


def _scalar(value: Any) -> str:
    """One value in YAML's flow style, on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=float("inf"))
    return text.removesuffix("\n").removesuffix("\n...")
