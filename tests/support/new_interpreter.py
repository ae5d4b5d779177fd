"""Programs for a new interpreter, where a test needs a process in which Taichi has not been started."""

import os
import signal
import subprocess
import sys


def python(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program in a new interpreter."""
    environment = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, env=environment
    )


def output(program: str, **environment: str) -> str:
    done = python(program, **environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


def obey_hangups() -> None:
    """For a new process: SIGHUP has its usual effect, even if the tests run under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
