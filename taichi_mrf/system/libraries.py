"""Optional libraries: loaded when they are first used; without them, the error names what to install."""

import importlib
import importlib.util
from typing import Any

from taichi_mrf.errors import TaichiMRFError


def library(name: str, who_needs: str, extra: str, error: type[TaichiMRFError] = TaichiMRFError) -> Any:
    """The module ``name``, which comes with an ``extra`` of this package.

    Raises ``error`` if it is not there: ``who_needs``, such as "meshes need", begins its text, which says
    what to install.
    """
    try:
        return importlib.import_module(name)
    except ImportError as missing:
        package = name.removeprefix("google.").partition(".")[0]  # google is the beginning of many
        raise error(
            f"{who_needs} {package}, which is not installed: pip install 'taichi-mrf[{extra}]'"
        ) from missing


def installed(*names: str) -> bool:
    """True if all the modules can be loaded."""
    return all(importlib.util.find_spec(name) is not None for name in names)
