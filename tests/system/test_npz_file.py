"""Arrays of a file that is not trusted: what only shows in their values."""

import zipfile
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
        pytest.raises(MapFileError, match=r"names\.npz: names holds a character outside Unicode"),
    ):
        file.array("names", "U", (None,))


def test_arrays_that_unpack_to_far_more_than_the_file_holds_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taichi_mrf.system.packed.LEAST_BYTES", 3_000_000)
    path = tmp_path / "zeros.npz"
    noise = np.random.default_rng(0).integers(0, 256, 5_000_000, dtype=np.uint8)
    arrays = {"a": np.zeros(2_000_000, np.uint8), "b": np.zeros(2_000_000, np.uint8)}
    np.savez_compressed(path, **arrays)
    with open_npz(path, MapFileError, "a map") as file:
        assert len(file["a"]) == 2_000_000
        with pytest.raises(MapFileError, match=r"zeros\.npz: b unpacks to 0\.002 GB, .* of 0\.0\d+ MB"):
            file["b"]
        assert len(file["a"]) == 2_000_000  # read again, it takes no more
    np.savez_compressed(path, **arrays, noise=noise)
    with open_npz(path, MapFileError, "a map") as file:
        assert len(file["noise"]) == 5_000_000
        assert len(file["a"]) == len(file["b"]) == 2_000_000


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("read", ["header", "__getitem__"])
def test_members_are_unpacked_by_deflate_alone(tmp_path: Path, method: int, read: str) -> None:
    """Python's other unpackers unpack all that they are given at once, whatever is asked of them."""
    path = tmp_path / "bomb.npz"
    np.savez(path, a=np.zeros(8))
    with zipfile.ZipFile(path) as plain, zipfile.ZipFile(tmp_path / "other.npz", "w", method) as other:
        other.writestr("a.npy", plain.read("a.npy"))
    with (
        open_npz(tmp_path / "other.npz", MapFileError, "a map") as file,
        pytest.raises(MapFileError, match=rf"other\.npz: a is packed by the method {method}, not by deflate"),
    ):
        getattr(file, read)("a")
