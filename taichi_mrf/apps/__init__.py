"""The applications. An installation has their files here; in a clone they lie in ``apps/`` at its top."""

from pathlib import Path

__path__.append(str(Path(__file__).resolve().parents[2] / "apps"))
