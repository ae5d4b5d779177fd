"""A disk that is full while a file is written: whatever writes it, one line names the file, and none is left.

A limit on the size of files fails in the middle of writing as a full disk does.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_room
from full_disk import files_up_to

from taichi_mrf.errors import MapFileError
from taichi_mrf.evaluation.pictures.run_pictures import write_pictures
from taichi_mrf.evaluation.tables import Table, write_table
from taichi_mrf.export.formats import FORMATS, export_map
from taichi_mrf.export.options import ExportOptions
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.system.atomic import write_text

pytestmark = pytest.mark.usefixtures("one_backend")

LEVEL = ExportOptions(z_min=-0.5, z_max=0.5)


@pytest.fixture(scope="module")
def m() -> MRFMap:
    return small_room.build([0, 1])


def refused(write: Callable[[], object], folder: Path) -> None:
    """Write on a disk that takes files first, so that the old ones must stay, and then does not."""
    write()
    before = contents(folder)
    with files_up_to(50), pytest.raises(MapFileError, match="cannot be written: ") as caught:
        write()
    assert str(folder) in str(caught.value)
    assert ".part-" not in str(caught.value)  # the file that was asked for, not the one beside it
    assert "\n" not in str(caught.value)
    assert contents(folder) == before


def contents(folder: Path) -> dict[Path, bytes]:
    """The bytes of all files in a folder and in those below."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("extension", FORMATS)
def test_every_export(m: MRFMap, tmp_path: Path, extension: str) -> None:
    refused(lambda: export_map(m, tmp_path / f"map{extension}", LEVEL), tmp_path)


def test_the_map_itself(m: MRFMap, tmp_path: Path) -> None:
    refused(lambda: m.save(tmp_path / "map.npz"), tmp_path)


def test_pictures(m: MRFMap, tmp_path: Path) -> None:
    refused(lambda: write_pictures(tmp_path, m, []), tmp_path)


def test_reports_and_tables(tmp_path: Path) -> None:
    refused(lambda: write_text(tmp_path / "report.json", "x" * 1000), tmp_path)
    table = Table("scores", "Scores", ["method", "score"], [[f"m{i}", float(np.sqrt(i))] for i in range(9)])
    refused(lambda: write_table(tmp_path, table), tmp_path)
