"""Kernels start sooner: what the compiler does again for each function and each call of it is done once.

Each process compiles its kernels from their source to the compiler's form, also where the machine code comes
from its cache. Taichi 1.7.4 spends more than a third of that time on words:

- For each expression it notes the file, the line, and the source text wrapped to 80 columns with marks under
  it. Only error messages show these notes. Here the text is made when there is an error, and otherwise the
  note is the file and the line alone.
- For each function it looks through all modules for the one that defines it, to see whether it stands in a
  class. Here it looks at that line of the source.
- For each call of a function it finds, cuts out and wraps the function's source. Here this is kept.

For each array that is made, at any time, Taichi also formats the whole stack of calls, for a message of its
debug mode. Here it does not.
"""

import ast
import functools
import linecache
import re
import sys
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from taichi_mrf.system import compiler, compiling

_maker, _method = compiler.note_maker()
_full_note = getattr(_maker, _method)


def hasten() -> None:
    """Have the compiler do so from now on, for the kernels of other packages too."""
    setattr(_maker, _method, _note)
    module = compiler.decorators()
    # Not a def: the compiler counts the frames between itself and the class.
    module._inside_class = functools.partial(_is_in_class, module._KERNEL_CLASS_STACKFRAME_STMT_RES)
    if hasattr(module, "getsourcelines"):  # Quadrants keeps them
        module.getsourcefile = functools.cache(module.getsourcefile)
        module.getsourcelines = functools.cache(module.getsourcelines)
        words = module.textwrap
        module.textwrap = SimpleNamespace(fill=functools.cache(words.fill), dedent=words.dedent)
    arrays = compiler.arrays()
    if hasattr(arrays, "get_traceback"):
        arrays.get_traceback = str
    compiling.watch()


def _note(context: Any, node: ast.stmt | ast.expr) -> str:
    if sys.exc_info()[0] is not None:
        full: str = _full_note(context, node)
        return full
    name = context.func.func.__name__
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {name}:\n'


def _is_in_class(statements: Sequence[re.Pattern[str]], level_of_class_stackframe: int) -> bool:
    """True if the frame so far up the stack is at one of the ``statements`` that open a class."""
    try:
        frame = sys._getframe(level_of_class_stackframe)
    except ValueError:  # a kernel at the top of a program
        return False
    line = linecache.getline(frame.f_code.co_filename, frame.f_lineno, frame.f_globals).strip()
    return any(statement.match(line) for statement in statements)
