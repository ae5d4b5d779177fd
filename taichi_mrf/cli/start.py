"""Entry point of the program, however it is called: ``taichi-mrf``, ``python -m taichi_mrf``, or a file of
``apps/`` in a clone, where its dependencies may not be installed."""

import os
import sys
from pathlib import Path

NOT_INSTALLED = 2


def start(*command: str) -> int:
    """Run the ``command`` that an application carries out, or the one that is typed, with the arguments that
    are typed; returns the exit status. Without a package that is needed, one line says what to install."""
    # NumPy's BLAS reads this when it is loaded. Products are small here, and its threads wait by spinning:
    # beside other work 140,000 points are turned in 1 ms in place of 55.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from taichi_mrf.cli.main import main

        return main([*command, *sys.argv[1:]])
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("", "taichi_mrf"):  # a mistake of this package
            raise
        clone = Path(__file__).resolve().parents[2]
        package = f"'{clone}'" if (clone / "pyproject.toml").is_file() else "taichi-mrf"
        problem = f"the package {missing} is not installed: pip install {package} adds all that is needed"
        print(f"taichi-mrf: {problem}", file=sys.stderr)
        return NOT_INSTALLED
