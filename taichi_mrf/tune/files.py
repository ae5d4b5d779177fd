"""The files that tuning leaves: a try's parameters, and the table of all tries."""

from pathlib import Path

from taichi_mrf.system.atomic import write_text
from taichi_mrf.tune.history import History

TABLE_FILE = "tries.csv"
BEST_FILE = "best.yaml"


def yaml_file(history: History, number: int, out: Path | None) -> tuple[str, str]:
    """Name and text of a try's parameters, which are also left in the folder ``out`` if there is one.

    Raises ConfigError for a try that there is not, MapFileError if the file cannot be written.
    """
    return _left(f"try-{number}.yaml", history.to_yaml(number), out)


def csv_file(history: History, number: int, out: Path | None) -> tuple[str, str]:
    """The same for the table; ``number`` says nothing here."""
    return _left(TABLE_FILE, history.to_csv(), out)


def _left(name: str, text: str, out: Path | None) -> tuple[str, str]:
    if out is not None:
        write_text(out / name, text)
    return name, text
