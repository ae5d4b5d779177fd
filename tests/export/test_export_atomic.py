"""Files are written whole or not at all."""

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from taichi_mrf.errors import MapFileError
from taichi_mrf.system.atomic import atomic_path, remove_leftovers, write_npz, write_text


def test_text_is_written_as_it_is(tmp_path: Path) -> None:
    write_text(tmp_path / "a.yaml", "σ: 1\nb: 2\n")
    assert (tmp_path / "a.yaml").read_bytes() == "σ: 1\nb: 2\n".encode()
    write_text(tmp_path / "a.yaml", "new")
    assert (tmp_path / "a.yaml").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]


def test_temporary_lies_beside_the_target_with_its_suffix(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "picture.png") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        temporary.write_bytes(b"x")
        assert not (tmp_path / "picture.png").exists()
    assert (tmp_path / "picture.png").read_bytes() == b"x"


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_failure_inside_leaves_the_old_file(tmp_path: Path, failure: type[BaseException]) -> None:
    target = tmp_path / "map.npz"
    target.write_bytes(b"old")

    def half_written() -> None:
        with atomic_path(target) as temporary:
            temporary.write_bytes(b"half")
            raise failure

    with pytest.raises(failure):
        half_written()
    assert target.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]


def test_symbolic_link_stays_a_link(tmp_path: Path) -> None:
    real = tmp_path / "real.txt"
    real.write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to(real)
    write_text(link, "new")
    assert link.is_symlink()
    assert real.read_text() == "new"


def test_missing_folder_is_one_line_that_names_the_file(tmp_path: Path) -> None:
    with refusal(MapFileError, "absent/report.json: cannot be written: No such file"):
        write_text(tmp_path / "absent" / "report.json", "{}")


def test_target_that_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(MapFileError, match="taken: cannot be written"):
        write_text(tmp_path / "taken", "x")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_file_that_cannot_grow_leaves_the_old_one(tmp_path: Path) -> None:
    """A file-size limit fails in the middle of writing, like a full disk."""
    from full_disk import files_up_to  # which skips the test where there are no such limits

    target = tmp_path / "map.npz"
    write_npz(target, {"a": np.arange(3)})
    old = target.read_bytes()
    noise = np.random.default_rng(0).integers(0, 256, 1_000_000, dtype=np.uint8)
    with (
        files_up_to(300_000),
        pytest.raises(MapFileError, match=r"map\.npz: cannot be written: File too large"),
    ):
        write_npz(target, {"noise": noise})
    assert target.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["map.npz"]


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    arrays = {
        "messages": rng.normal(size=(50, 512)).astype(np.float16),
        "fortran": np.asfortranarray(rng.normal(size=(7, 5))),
        "strided": rng.integers(0, 9, (40, 6))[::2, ::-1],
        "empty": np.zeros((0, 3)),
        "scalar": np.array(0.02),
        "names": np.array(["frame-000000", "σ"]),
    }
    write_npz(tmp_path / "map.npz", arrays)
    with np.load(tmp_path / "map.npz") as loaded:
        assert set(loaded.files) == set(arrays)
        for name, array in arrays.items():
            assert loaded[name].dtype == array.dtype
            np.testing.assert_array_equal(loaded[name], array)


def test_same_arrays_same_bytes_and_compressed(tmp_path: Path) -> None:
    arrays = {"zeros": np.zeros((1000, 100)), "ones": np.ones(5)}
    for name in ("a.npz", "b.npz"):
        write_npz(tmp_path / name, arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert (tmp_path / "a.npz").stat().st_size < arrays["zeros"].nbytes / 50
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {member.date_time[0] for member in archive.infolist()} == {1980}


def test_objects_are_refused_without_a_trace(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(tmp_path / "map.npz", {"objects": np.array([{}, None])})
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_killed_processes_are_removed_and_nothing_else(tmp_path: Path) -> None:
    kept = ["map.npz", ".hidden", ".map.npz", ".a.part-1-012345.npz"]
    dead = 2**30  # no system numbers its processes so high
    left = [
        f".map.part-{dead}-0123abcd.npz",
        f".voxels.part-{dead}-00000000.ply",
        f".LICENSE.part-{dead}-ffffffff",
    ]
    for name in (*kept, *left):
        (tmp_path / name).touch()
    half = tmp_path / f".map.part-{dead}-89abcdef.zarr"
    half.mkdir()
    (half / "zarr.json").touch()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(kept)
    remove_leftovers(tmp_path / "not there")


@pytest.mark.skipif(os.name == "nt", reason="FIFOs and devices in the file system are a POSIX feature")
def test_a_target_that_is_no_regular_file_is_left_alone(tmp_path: Path) -> None:
    fifo, link = tmp_path / "fifo.npz", tmp_path / "link.npz"
    os.mkfifo(fifo)
    link.symlink_to("/dev/null")
    for path, kind in ((fifo, "a FIFO"), (link, "a device"), (Path("/dev/null"), "a device")):
        with pytest.raises(MapFileError, match=f"{path}: cannot be written: it is {kind}, not"):
            write_npz(path, {"a": np.arange(3)})
    assert fifo.is_fifo()
    assert Path("/dev/null").is_char_device()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo.npz", "link.npz"]


def test_a_name_that_is_too_long_is_our_error_and_one_that_is_just_not_is_written(tmp_path: Path) -> None:
    longest = tmp_path / ("ü" * 125 + ".txt")  # 254 bytes of the 255 that file systems take
    write_text(longest, "x")
    assert [path.name for path in tmp_path.iterdir()] == [longest.name]
    for name in ("x" * 300, "x" * 5000, "a\0b"):
        with pytest.raises(MapFileError, match=r"File name too long|not the name of a file"):
            write_text(tmp_path / name, "x")
