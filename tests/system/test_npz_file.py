"""Arrays of a file that is not trusted: what only shows in their values."""

from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.errors import MapFileError
from taichi_mrf.system.npz_file import open_npz


@pytest.mark.parametrize("order", ["<", ">"])
def test_text_is_read_whichever_way_its_bytes_lie(tmp_path: Path, order: str) -> None:
    path = tmp_path / "names.npz"
    np.savez(
        path,
        names=np.array(["kitchen", "K\u00fcche \U0001f373", ""]).astype(f"{order}U12"),
        none=np.array([], "U1"),
    )
    with open_npz(path, MapFileError, "a map") as file:
        assert file.array("names", "U", (None,)).tolist() == ["kitchen", "K\u00fcche \U0001f373", ""]
        assert file.array("none", "U", (None,)).tolist() == []


@pytest.mark.parametrize("order", ["<", ">"])
def test_text_with_a_character_that_there_is_not_is_refused(tmp_path: Path, order: str) -> None:
    path = tmp_path / "names.npz"
    codes = np.full(4, ord("a"), f"{order}u4")
    codes[2] = 0x110000
    np.savez(path, names=codes.view(f"{order}U4"))
    with (
        open_npz(path, MapFileError, "a map") as file,
        pytest.raises(MapFileError, match=r"names\.npz: names holds a character that there is not"),
    ):
        file.array("names", "U", (None,))
