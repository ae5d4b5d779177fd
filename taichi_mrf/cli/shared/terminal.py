"""The only way to the terminal: all text is made printable here.

Names of files, frames and parameters come from data that somebody else may have written. A control character
in them could move the cursor, change the window's title or hide text; it is shown as an escape: \\x1b.
"""

import sys
from typing import Any

from rich.console import Console
from rich.text import Text

PROGRAM = "taichi-mrf"

DID_NOT_FIT = 3
"""Exit status of a run that ran out of memory: the map of the frames that fit was saved."""

READ_WRONG = 4
"""Exit status for a recording that is certainly misread, or that contradicts its map."""


def printable(text: str) -> str:
    """The text with every character that a terminal could obey, tabs and line breaks apart, as an escape."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() or each in "\n\t" else _escape(each) for each in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


class Terminal(Console):
    """A rich console without markup that shows control characters of all text, in tables too, as escapes."""

    def __init__(self, stderr: bool = False, quiet: bool = False) -> None:
        super().__init__(stderr=stderr, quiet=quiet, markup=False, highlight=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string that is printed or stands in a table."""
        return super().render_str(printable(text), **options)

    def print_line(self, text: str, style: str | None = None) -> None:
        """Print a line without breaking it."""
        self.print(text, style=style, soft_wrap=True)


def print_problem(text: str) -> None:
    """Print one line on stderr that says what is wrong."""
    print(f"{PROGRAM}: {printable(text).translate(_ONE_LINE)}", file=sys.stderr)


_ONE_LINE = str.maketrans({"\n": "\\n", "\t": " "})
