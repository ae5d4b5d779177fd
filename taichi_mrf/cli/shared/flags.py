"""How the configuration dataclasses become flags: with the help text that stands under each field."""

import dataclasses
import typing

from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from taichi_mrf.calibration import options as calibration_options
from taichi_mrf.config import schema as config
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.text import field_help
from taichi_mrf.factor_graph import config as factor_graph_config

DEFINITIONS = (
    config.__name__,
    *(method.section_class.__module__ for method in METHODS.values()),
    calibration_options.__name__,
    factor_graph_config.__name__,
)
"""The modules whose dataclasses are parameters."""

registry = ConstructorRegistry()
"""For :func:`tyro.cli`, which by itself keeps the line breaks that the source code has in a help text."""


@registry.struct_rule
def configuration_flags(info: StructTypeInfo) -> StructConstructorSpec | None:
    """One flag a field for the dataclasses of DEFINITIONS; nothing for any other type."""
    if not (dataclasses.is_dataclass(info.type) and info.type.__module__ in DEFINITIONS):
        return None
    hints, texts = typing.get_type_hints(info.type), field_help(info.type)
    defaults = info.default if isinstance(info.default, info.type) else info.type()
    fields = (
        StructFieldSpec(field.name, hints[field.name], getattr(defaults, field.name), texts[field.name])
        for field in dataclasses.fields(info.type)
    )
    return StructConstructorSpec(info.type, tuple(fields))
