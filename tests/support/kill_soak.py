"""Kills runs of ``taichi-mrf map`` at random steps, up to three times each, resumes them, and compares what
they leave with an undisturbed run's, byte for byte.

    python tests/support/kill_soak.py --runs 50 --seed 0

Ends with status 1 if any differs.
"""

import argparse
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

from killed_runs import Run, disturbed

METHODS = (
    ("--method", "mrf"),
    ("--method", "mrf"),
    ("--method", "log_odds"),
    ("--method", "visibility"),
    ("--refine-poses", "--inference.sweeps", "2"),
)


def main() -> int:
    """Run, print what was found, and say by the exit status whether it is good."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    stages: Counter[str] = Counter()
    kept, kills, different = 0, 0, 0
    with tempfile.TemporaryDirectory() as place:
        undisturbed = {}
        for number in range(arguments.runs):
            options = METHODS[number % len(METHODS)]
            if options not in undisturbed:
                whole = Run(Path(place) / f"whole {len(undisturbed)}", options)
                undisturbed[options] = len(whole.go()), whole.digests()
            steps, digests = undisturbed[options]
            draw = random.Random(arguments.seed + number)
            run = disturbed(Path(place) / f"run {number}", draw, steps, options)
            stages.update(kill.stage for kill in run.kills)
            kills += len(run.kills)
            kept += sum(kill.keyframes > 0 for kill in run.kills)
            if run.digests() != digests:
                different += 1
                print(
                    f"DIFFERENT: seed {arguments.seed + number}, {' '.join(options)}: {run.kills}", flush=True
                )
    print(f"{arguments.runs} runs, {kills} kills; after {kept} of them there were keyframes on disk")
    print("kills by stage: " + ", ".join(f"{stage} {count}" for stage, count in stages.most_common()))
    print(f"{arguments.runs - different} of {arguments.runs} ended in the undisturbed run's files")
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main())
