"""The applications. An installation has their files here; in a clone they lie in ``apps/`` at its top."""

from pathlib import Path

_HERE = Path(__file__).resolve().parent

if not (_HERE / "batch.py").is_file():
    __path__.append(str(_HERE.parents[1] / "apps"))
