"""Check the types, and run the test suite once for each backend that there is here: the CPU with all tests,
the others with those that are marked `backends`, `compilers` or `smoke`. Where a second compiler of kernels
is installed, the CPU's tests that are marked `compilers` or `smoke` run with that too.

    python tests/backends.py [options of pytest]

With --quick the CPU alone has its turn. Some processes run the CPU's tests; each takes the next folder that
is not taken yet. All run side by side, because tests of pages and processes wait more than they compute. Each
one's output is printed in one piece: the first's as it comes, the others' when that is done.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from typing import IO

from taichi_mrf.system import compiler, runtime

PROCESSES, QUICK_PROCESSES = 3, 2

Run = tuple[str, subprocess.Popen[bytes], IO[bytes]]


def main() -> int:
    """0 if all runs are good, else the status of the first that is not."""
    found = [status.name for status in reversed(runtime.backends()) if status.problem is None]
    if not found:
        print("Taichi has no backend here", file=sys.stderr)
        return 1
    if hasattr(os, "nice"):  # not on Windows
        # The least priority: `live` and `tune` lower theirs, and would wait for all tests of higher priority.
        os.nice(19)
    first, *others = found
    quick = "--quick" in sys.argv[1:]
    processes, others = (QUICK_PROCESSES, []) if quick else (PROCESSES, others)
    with ExitStack() as stack:
        queue = stack.enter_context(tempfile.TemporaryDirectory())
        command = [sys.executable, "-m", "pytest", "--quiet", *sys.argv[1:], "--arch"]
        # The folder in one word: pytest takes it for tests. No part of the whole, which no process knows.
        share = [*command, first, f"--queue={queue}", "-o", "console_output_style=classic"]
        beside = {arch: [*command, arch] for arch in others}
        beside["mypy"] = [sys.executable, "-m", "mypy"]
        beside |= {_name(first, number, processes): share for number in range(2, processes + 1)}
        if not quick:
            beside |= {name: [*command, "cpu", "-m", "compilers or smoke"] for name in _other_compilers()}
        runs = []
        for name, its_command in beside.items():
            output = stack.enter_context(tempfile.TemporaryFile())
            chosen = name if name in compiler.COMPILERS else compiler.name()
            process = subprocess.Popen(
                its_command,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, compiler.VARIABLE: chosen},
            )
            runs.append((name, process, output))
        return _finish(_name(first, 1, processes), share, runs)


def _name(arch: str, number: int, processes: int) -> str:
    return f"{arch}, process {number} of {processes}"


def _other_compilers() -> list[str]:
    """Those that are installed beside the one that compiles here."""
    installed = [name for name in compiler.COMPILERS if importlib.util.find_spec(name) is not None]
    return [name for name in installed if name != compiler.name()]


def _finish(first: str, command: list[str], runs: list[Run]) -> int:
    """Run one command here, then wait for the others and print what they printed."""
    print(f"== {first}; beside it: {'; '.join(name for name, _, _ in runs)}", flush=True)
    status = subprocess.run(command, check=False).returncode
    for name, process, output in runs:
        status = process.wait() or status
        output.seek(0)
        print(f"== {name}", flush=True)
        sys.stdout.buffer.write(output.read())
        sys.stdout.flush()
    return status


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
