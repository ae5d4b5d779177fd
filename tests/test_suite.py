"""The suite itself: a run that leaves tests out still runs the others."""

import os
import subprocess
import sys
from pathlib import Path


def test_quick_runs_tests_on_a_machine_that_has_never_drawn(repository: Path, tmp_path: Path) -> None:
    """When Matplotlib is first imported it lists the fonts by a process, and --quick starts none."""
    output = subprocess.run(
        [sys.executable, "-m", "pytest", "--quick", "-q", "tests/test_floors.py"],
        cwd=repository,
        env={**os.environ, "MPLCONFIGDIR": str(tmp_path)},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert " passed" in output, output
