"""Run the test suite once for each backend that there is here: the CPU with all tests, the others with
those that use a backend.

    python tests/backends.py [options of pytest]

The runs go on side by side, because one alone seldom keeps two cores busy. Each one's output is printed in
one piece: the CPU's as it comes, the others' when that is done.
"""

import subprocess
import sys
import tempfile
from contextlib import ExitStack
from typing import IO

from taichi_mrf import runtime

Run = tuple[str, subprocess.Popen[bytes], IO[bytes]]


def main() -> int:
    """0 if all runs are good, else the status of the first that is not."""
    found = [status.name for status in reversed(runtime.backends()) if status.problem is None]
    if not found:
        print("Taichi has no backend here", file=sys.stderr)
        return 1
    first, *others = found
    command = [sys.executable, "-m", "pytest", *sys.argv[1:], "--arch"]
    with ExitStack() as files:
        runs = []
        for arch in others:
            output = files.enter_context(tempfile.TemporaryFile())
            process = subprocess.Popen([*command, arch], stdout=output, stderr=subprocess.STDOUT)
            runs.append((arch, process, output))
        return _finish(first, [*command, first], runs)


def _finish(first: str, command: list[str], runs: list[Run]) -> int:
    """Run the first backend's tests here, then wait for the others and print what they said."""
    others = [arch for arch, _, _ in runs]
    print(f"== pytest on {first}; beside it: {', '.join(others) or 'nothing'}", flush=True)
    status = subprocess.run(command, check=False).returncode
    for arch, process, output in runs:
        status = status or process.wait()
        process.wait()
        output.seek(0)
        print(f"== pytest on {arch}", flush=True)
        sys.stdout.buffer.write(output.read())
        sys.stdout.flush()
    return status


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
