"""The folder of a run: one run at a time, and a lock that a dead process leaves is none."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from console import FAST, ROOM, assert_refused, taichi_mrf

from taichi_mrf.cli.shared.output import LOCK_FILE, output_folder
from taichi_mrf.errors import MapFileError

HOLD = (
    "import sys\nfrom pathlib import Path\nfrom taichi_mrf.cli.shared.output import output_folder\n"
    "with output_folder(Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
)


def holder(folder: Path) -> "subprocess.Popen[str]":
    """A process that holds a folder until its stdin ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_run_names_the_first_and_a_dead_one_holds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with holder(out) as process:
        done = taichi_mrf("map", ROOM, "--out", out, *FAST)
        assert_refused(done, str(out), f"process {process.pid} on {socket.gethostname()}")
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (out / LOCK_FILE).exists()
    with output_folder(out):
        assert f"process {os.getpid()} " in (out / LOCK_FILE).read_text()
    assert not list(out.iterdir())


def test_patience_outlasts_a_process_that_ends(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").touch()
    with holder(tmp_path) as process:
        with pytest.raises(MapFileError, match="another run uses this folder"), output_folder(tmp_path):
            pass
        assert process.stdin is not None
        process.stdin.close()
        with output_folder(tmp_path, patience_s=60.0):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["kept.txt"]
