"""The options of a built-in source, which follow a question mark in its name: ``name?option=value&...``."""

from typing import TypeVar, get_type_hints

from taichi_mrf.config.files import parse_yaml
from taichi_mrf.config.values import from_dict
from taichi_mrf.errors import ConfigError, DatasetError

T = TypeVar("T")


def parse_options(cls: type[T], query: str, source: str) -> T:
    """What stands after the question mark, as a dataclass whose fields are all options that there are.

    A field of type str takes its text as it stands, such as a path. Raises DatasetError, whose text names
    the source, for an option that does not exist (naming the nearest), a value of the wrong type or out of
    range, and for a text that is not made of name=value.
    """
    texts = {field for field, hint in get_type_hints(cls).items() if hint is str}
    values = {}
    for option in query.split("&") if query else ():
        name, equals, text = option.partition("=")
        try:
            values[name] = text if name in texts else parse_yaml(text)
        except ValueError:
            equals = ""
        if not (name and equals):
            raise DatasetError(f"{source}?{query}: options are written name=value, with & between them")
    try:
        return from_dict(cls, values, source)
    except ConfigError as error:
        raise DatasetError(str(error)) from error
