"""Programs for a new interpreter, where a test needs a process in which Taichi has not been started."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any


def python(
    *arguments: str | Path, cwd: Path | None = None, before: Any = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a new interpreter with these arguments; ``before`` is called in its process."""
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, cwd=cwd, preexec_fn=before,
        env={**os.environ, **environment},
    )  # fmt: skip


def output(program: str, **environment: str) -> str:
    done = python("-c", program, **environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


def obey_hangups() -> None:
    """For a new process: SIGHUP has its usual effect, even if the tests run under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
