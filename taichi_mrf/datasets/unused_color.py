"""Whether a recording has colour images that a command does not read, for a note that says so."""

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.registry import open_dataset
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.errors import TaichiMRFError

UNUSED_COLOR = "color: there are colour images, which are not used; --color gives their colours to the map"


def note_unused_color(dataset: Dataset, source: str, reading: SourceFlags) -> None:
    """Add UNUSED_COLOR to the notes of a dataset that was opened without colours if the first frame of its
    source has some. A source without end is not looked at: it cannot be opened twice."""
    if not dataset.endless and _has_color(source, reading):
        dataset.notes.append(UNUSED_COLOR)


def _has_color(source: str, reading: SourceFlags) -> bool:
    try:
        return open_dataset(source, color=True, **reading.keywords()).read(0).color is not None
    except TaichiMRFError:  # of the colours alone: the dataset without them is open
        return False
