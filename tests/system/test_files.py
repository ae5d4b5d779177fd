"""Only regular files are opened, and whatever else is at a path is an error that says so."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from taichi_mrf.errors import DatasetError
from taichi_mrf.system.files import exists, is_file, is_folder, open_regular, read_bytes, read_text

TOO_LONG = "x" * 5000


def fifo(path: Path) -> None:
    os.mkfifo(path)


def unix_socket(path: Path) -> None:
    socket.socket(socket.AF_UNIX).bind(str(path))


def link_to_an_endless_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.skipif(os.name == "nt", reason="FIFOs and devices in the file system are a POSIX feature")
@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (fifo, "a FIFO"),
        (unix_socket, "a socket"),
        (link_to_an_endless_device, "a device"),
        (Path.mkdir, "a folder"),
    ],
)
def test_what_is_no_regular_file_is_refused_without_opening_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], None], kind: str
) -> None:
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    path = Path("depth.png")
    make(path)
    for read in (read_bytes, read_text, open_regular):
        with pytest.raises(DatasetError, match=rf"depth\.png: cannot be read: it is {kind}, not"):
            read(path, DatasetError)


def test_a_path_that_is_too_long_or_none_is_our_error() -> None:
    with pytest.raises(DatasetError, match="cannot be read: File name too long"):
        read_bytes(TOO_LONG, DatasetError)
    with pytest.raises(DatasetError, match="not the name of a file"):
        read_bytes("a\0b", DatasetError)
    for path in (TOO_LONG, "a\0b", "absent"):
        assert not any(test(path) for test in (exists, is_file, is_folder))


def test_a_file_is_read_as_it_is_and_a_text_with_plain_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("σ\r\nb\rc\n".encode())
    assert read_bytes(path, DatasetError) == "σ\r\nb\rc\n".encode()
    assert read_text(path, DatasetError) == "σ\nb\nc\n"
    with open_regular(path, DatasetError) as file:
        assert file.readline() == "σ\r\n".encode()


def test_what_is_missing_too_large_or_no_text_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"b\.txt: the pose is missing"):
        read_text(tmp_path / "b.txt", DatasetError, missing="the pose is missing")
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xff" * 11)
    with pytest.raises(DatasetError, match=r"a\.txt: has 11 bytes; at most 10 are expected"):
        read_bytes(path, DatasetError, most_bytes=10)
    with pytest.raises(DatasetError, match=r"a\.txt: not a text file"):
        read_text(path, DatasetError)
