"""Where in the source each part of a kernel stands, in a short form, so that kernels compile faster.

Taichi 1.7.4 makes a note for each expression that it compiles: the file, the line, and the source text
wrapped to 80 columns with marks under it. Only error messages show these notes, yet the wrapping takes a
fifth of the time from a kernel's first call to its start when its code is in Taichi's cache. Here the text
is made when there is an error, and otherwise the note is the file and the line alone.
"""

import ast
import sys
from typing import Any

from taichi_mrf.system import compiler

_maker, _method = compiler.note_maker()
_full_note = getattr(_maker, _method)


def _note(context: Any, node: ast.stmt | ast.expr) -> str:
    if sys.exc_info()[0] is not None:
        full: str = _full_note(context, node)
        return full
    name = context.func.func.__name__
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {name}:\n'


def shorten() -> None:
    """Have Taichi make short notes from now on, in the kernels of other packages too."""
    setattr(_maker, _method, _note)
