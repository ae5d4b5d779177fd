"""Libraries that only some users need: loaded when they are first used, and one helpful line without them."""

import importlib
from typing import Any

from taichi_mrf.errors import TaichiMRFError


def library(name: str, what: str, extra: str) -> Any:
    """The module ``name``, which ``what`` need and which comes with an extra of this package.

    Raises TaichiMRFError, which says what to install, if it is not there.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise TaichiMRFError(
            f"{what} need {package}, which is not installed: pip install 'taichi-mrf[{extra}]'"
        ) from error
