"""Damages files and reads them for as long as it is told to, and counts what came of it.

    python tests/support/fuzz_soak.py --minutes 10 --seed 0

A process of its own reads; one that crashes, takes longer than HANG_S over a case, or more memory than
MOST_MEMORY_GB on top of what it starts with, is a failure, and so is every error that is not this package's.
Ends with status 1 if there was any; each is printed with the loader and the seed that repeat it.
"""

import argparse
import faulthandler
import resource
import sys
import tempfile
import time
from collections import Counter
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

HANG_S = 60.0
MOST_MEMORY_GB = 3.0
FIRST_CASE_S = 300.0
"""A process starts Taichi first and compiles its kernels."""

OUTCOMES = ("refused", "same", "other", "failed")


def work(pipe: Connection, folder: str) -> None:
    """Carry out the cases that come through the pipe, until it closes."""
    faulthandler.enable()
    from fuzz_case import FuzzError, run_case
    from fuzz_loaders import LOADERS

    from taichi_mrf.system import runtime

    runtime.init("cpu")
    root = Path(folder)
    for loader in LOADERS:  # the good ones, so that no kernel is compiled when memory is short
        try:
            run_case(loader.name, 0, root)
        except FuzzError as failure:
            print(f"FAILED {failure}", flush=True)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = held + int(MOST_MEMORY_GB * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    pipe.send("ready")
    while True:
        try:
            name, seed = pipe.recv()
        except EOFError:
            return
        begin = time.monotonic()
        try:
            outcome = run_case(name, seed, root)
            pipe.send((outcome.kind, outcome.said, time.monotonic() - begin))
        except FuzzError as failure:
            pipe.send(("failed", str(failure), time.monotonic() - begin))


class Worker:
    """The process that reads."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.pipe, theirs = get_context("spawn").Pipe()
        self._process = get_context("spawn").Process(
            target=work, args=(theirs, self._folder.name), daemon=True
        )
        self._process.start()
        theirs.close()
        if not self.pipe.poll(FIRST_CASE_S) or self.pipe.recv() != "ready":
            raise SystemExit("the process that reads does not start")

    def run(self, name: str, seed: int) -> tuple[str, str, float]:
        """Outcome, words and seconds of a case."""
        try:
            self.pipe.send((name, seed))
            if self.pipe.poll(HANG_S):
                return self.pipe.recv()
            return "failed", f"{name}, seed {seed}: took longer than {HANG_S:g} s", HANG_S
        except (EOFError, OSError):
            self._process.join(10)
            return "failed", f"{name}, seed {seed}: the process ended with {self._process.exitcode}", 0.0

    @property
    def alive(self) -> bool:
        """Whether another case can be given to it."""
        return self._process.is_alive()

    def end(self) -> None:
        """End it, in whatever state it is."""
        self._process.kill()
        self._process.join()
        self._folder.cleanup()


def main() -> int:
    """Run, print what was found, and say by the exit status whether it is good."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first round")
    parser.add_argument("--only", default="", help="loaders whose name contains this")
    arguments = parser.parse_args()
    from fuzz_loaders import LOADERS

    names = [loader.name for loader in LOADERS if arguments.only in loader.name]
    counts: dict[str, Counter[str]] = {name: Counter() for name in names}
    slowest, failures = (0.0, ""), []
    worker = Worker()
    begin, seed = time.monotonic(), arguments.seed
    while time.monotonic() < begin + 60 * arguments.minutes:
        for name in names:
            kind, said, seconds = worker.run(name, seed)
            counts[name][kind] += 1
            slowest = max(slowest, (seconds, f"{name}, seed {seed}"))
            if kind == "failed":
                failures.append(said)
                print(f"FAILED {said}", flush=True)
                if not worker.alive or seconds >= HANG_S:
                    worker.end()
                    worker = Worker()
        seed += 1
    worker.end()
    total = sum(counts.values(), Counter())
    print(f"{'loader':28}" + "".join(f"{kind:>10}" for kind in OUTCOMES))
    for name, count in (*counts.items(), ("all", total)):
        print(f"{name:28}" + "".join(f"{count[kind]:>10}" for kind in OUTCOMES))
    print(f"seeds {arguments.seed} to {seed - 1}; the slowest case took {slowest[0]:.2f} s ({slowest[1]})")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
