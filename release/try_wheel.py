"""Builds wheel and source, checks both, and tries the wheel on each interpreter as a user installs it.

    python release/try_wheel.py [PYTHON ...]

PYTHON are interpreters; without any, every python3.10 to python3.13 of the PATH that answers. Wheel and
source are left in dist/. Everything is fetched by pip: the tools into an environment of their own.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
DIST = REPOSITORY / "dist"
VERSIONS = ("3.10", "3.11", "3.12", "3.13")

COMMANDS = (
    ("--version",),
    ("demo", "--help"),
    ("map", "synthetic:room", "--limit", "6", "--out", "room", "--quiet"),
    ("info", "room/map.npz"),
    ("export", "room/map.npz", "--to", "room.html"),
)
"""Commands to run from an empty folder."""


def main() -> None:
    """Build, check, try."""
    pythons = sys.argv[1:] or [path for path in (found(version) for version in VERSIONS) if path]
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder, "tools"))
        (wheel,) = DIST.glob("*.whl")
        for python in pythons:
            name = run(python, "-c", "import platform; print(platform.python_version())").strip()
            try_wheel(wheel, python, Path(folder, name))
            print(f"Python {name}: {wheel.name} is installed and maps the room", flush=True)
    if not pythons:
        sys.exit("there is no interpreter to try it on")


def found(version: str) -> str | None:
    """An interpreter of the PATH that answers: the names that pyenv leaves there may lead nowhere."""
    python = shutil.which(f"python{version}")
    answers = (
        python and subprocess.run([python, "--version"], capture_output=True, check=False).returncode == 0
    )
    return python if answers else None


def build(tools: Path) -> None:
    """Leave wheel and source in dist/, from the files that git knows: of others none may get into them."""
    python = environment(sys.executable, tools, "build", "twine")
    shutil.rmtree(DIST, ignore_errors=True)
    source = tools / "source"
    files = run("git", "ls-files", "-z", cwd=REPOSITORY).split("\0")[:-1]
    for name in files:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, source / name)
    run(python, "-m", "build", "--outdir", str(DIST), str(source))
    run(python, "-m", "twine", "check", "--strict", *map(str, DIST.iterdir()))


def try_wheel(wheel: Path, python: str, folder: Path) -> None:
    """Install it with all that it asks for, and run ``COMMANDS``."""
    program = Path(environment(python, folder / "venv", str(wheel))).parent / "taichi-mrf"
    (folder / "empty").mkdir()
    for words in COMMANDS:
        run(str(program), *words, cwd=folder / "empty")


def environment(python: str, folder: Path, *packages: str) -> str:
    """The interpreter of a new virtual environment with these packages."""
    run(python, "-m", "venv", str(folder))
    inner = str(folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python"))
    run(inner, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages)
    return inner


def run(*words: str, cwd: Path | None = None) -> str:
    """Output of a command. Ends the program with its words if it fails."""
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=cwd, env=alone)
    if done.returncode:
        sys.exit(f"{' '.join(words)}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    main()
