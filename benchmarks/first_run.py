"""The first run on a machine: `map synthetic:room` without compiled kernels, and how long it compiles them.

    python benchmarks/first_run.py --gate benchmarks/first_run.json

Compiling is measured in the processor's seconds, and compared as multiples of those of one reference kernel,
because machines differ and are busy with other things: with --gate the status is 1 if all kernels together
take a tenth more than the file says. --json writes such a file.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from os import environ
from pathlib import Path

import tyro

from taichi_mrf.system import (
    bundles,  # noqa: F401 (launches are watched)
    compiler,
    compiling,
    runtime,
)
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32Array, Template

WORSE = 1.1
"""A figure that has grown by more than this factor is worse."""

KERNELS = 15
"""Kernels that are listed."""

CHILD = """
import json, sys, time
begin = time.perf_counter()
from taichi_mrf.cli.main import main
imported = time.perf_counter() - begin
status = main(["map", "synthetic:room", "--quiet", "--runtime.arch", "cpu", "--out", sys.argv[1]])
from taichi_mrf.system.compiling import so_far
print(json.dumps({"importing": imported, "kernels": so_far.seconds, "status": status}))
"""


@dataclass(frozen=True)
class Options:
    """What to compare with, and where to write."""

    gate: Path | None = None
    """An earlier --json FILE; exit status 1 if compiling takes a tenth more."""

    json: Path | None = None
    """Write the figures to this file."""


@dataclass(frozen=True)
class FirstRun:
    """Seconds of one run: its ``stages`` in wall-clock time, the compiler's by kernel, and those of the
    reference kernel."""

    stages: dict[str, float]
    kernels: dict[str, float]
    reference: float

    @property
    def multiple(self) -> float:
        """Compiling of all kernels, in multiples of the reference kernel's."""
        return sum(self.kernels.values()) / self.reference


def measure() -> FirstRun:
    """Run the command in a process of its own, with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**environ, "XDG_CACHE_HOME": folder}
        out = Path(folder) / "out"
        done = subprocess.run(
            [sys.executable, "-c", CHILD, str(out)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        found = json.loads(done.stdout.splitlines()[-1])
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    stages = {"importing": round(found["importing"], 2), **report["seconds"]}
    return FirstRun(stages, found["kernels"], reference_s())


def reference_s() -> float:
    """Seconds of compiling the reference kernel here and now, the least of three: each is another kernel."""
    environ[compiler.variable("OFFLINE_CACHE")] = "0"
    runtime.init("cpu")
    values = ti.ndarray(ti.f32, 8)
    seconds = []
    for shift in range(3):
        before = compiling.so_far.total_s
        _reference(values, shift)
        seconds.append(compiling.so_far.total_s - before)
    return min(seconds)


@ti.kernel
def _reference(values: F32Array, shift: Template):  # noqa: ANN202 (Taichi allows no None)
    for i in range(values.shape[0]):
        x = values[i]
        for k in ti.static(range(30)):
            for j in ti.static(range(5)):
                if x > k + shift:
                    x = ti.sqrt(x * x + j) - values[(i + k) % 8]
                else:
                    x += ti.exp(-x) * (k + j)
        values[i] = x


def main(options: Options) -> int:
    """Measure, print and compare; returns the exit status."""
    found = measure()
    print("stage, wall-clock seconds:", ", ".join(f"{name} {s:.1f}" for name, s in found.stages.items()))
    for name, seconds in sorted(found.kernels.items(), key=lambda item: -item[1])[:KERNELS]:
        print(f"{seconds:8.2f} s  {name}")
    total = sum(found.kernels.values())
    print(f"{total:8.2f} s  all {len(found.kernels)}, {found.multiple:.1f} times the reference kernel")
    if options.json is not None:
        options.json.write_text(json.dumps(asdict(found), indent=1) + "\n", encoding="utf-8")
    if options.gate is not None:
        allowed = WORSE * FirstRun(**json.loads(options.gate.read_text(encoding="utf-8"))).multiple
        if found.multiple > allowed:
            print(
                f"compiling takes {found.multiple:.1f} times the reference kernel, {allowed:.1f} are allowed"
            )
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
