"""Tables of results on the terminal."""

from collections.abc import Iterable

from rich.measure import Measurement
from rich.table import Table as RichTable

from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.evaluation.tables import Table, entry_text

_WIDEST = 1000
"""Columns of text that no table needs."""


def print_facts(console: Terminal, title: str, facts: Iterable[tuple[str, str]]) -> None:
    """Print facts, each a name and a text, as a table without a head."""
    table = RichTable(show_header=False, title=title, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for name, text in facts:
        table.add_row(name, text)
    console.print(table)


def print_table(console: Terminal, table: Table) -> None:
    """Print a table and its notes, as wide as its longest words need at least."""
    shown = RichTable(title=table.title, title_justify="left")
    cells = [[entry_text(entry, table.digits) for entry in row] for row in table.rows]
    for number, column in enumerate(zip(table.columns, *cells, strict=True)):
        longest_word = max(len(word) for cell in column for word in cell.split())
        shown.add_column(column[0], justify="right" if number else "left", min_width=longest_word)
    for row in cells:
        shown.add_row(*row)
    # Chopped words and numbers cannot be read: rather let a narrow terminal wrap the lines of a wide table.
    needed = Measurement.get(console, console.options.update(max_width=_WIDEST), shown)
    width = needed.minimum if console.is_terminal else needed.maximum
    wide = Terminal(stderr=console.stderr, quiet=console.quiet)
    wide.width = max(console.width, width)
    wide.print(shown)
    for note in table.notes:
        console.print(note)
