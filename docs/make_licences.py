"""Makes docs/licences.md from what the packages state at the package index.

    python docs/make_licences.py    # Python 3.11 and pip 25, or later

pip names what an installation brings and reads the packages' metadata, without installing any.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import tomllib

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE = REPOSITORY / "docs" / "licences.md"
FOR_DEVELOPERS = {"dev", "docs"}

SHORT = {
    "MIT License": "MIT",
    "The MIT License (MIT)": "MIT",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "Python Software Foundation License": "PSF",
    "ISC License (ISCL)": "ISC",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Copyright (c) 2015, Anthony Scopatz": "BSD-2-Clause",
}
"""Words that some packages state in place of a licence's short name."""

TEXT = """# Licences

taichi_mrf itself is [MIT](../LICENSE). Its wheel holds no other project's code; a page that `export` writes
holds viser's. `python docs/make_licences.py` makes the lists from what the packages state.

## With every installation

`pip install taichi-mrf` brings, on Linux with x86-64 and Python {python}:

{base}

## With extras

{extras}
"""


def main() -> None:
    """Ask for both lists, write the page."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [
        requirement.partition(";")[0].strip()
        for extra, requirements in project["optional-dependencies"].items()
        if extra not in FOR_DEVELOPERS
        for requirement in requirements
    ]
    base = licences(*project["dependencies"])
    single: dict[str, str] = {}
    for requirement in dict.fromkeys(extras):  # one by one: some exclude each other
        single |= licences("--no-deps", requirement)
    python = ".".join(map(str, sys.version_info[:2]))
    PAGE.write_text(TEXT.format(python=python, base=listed(base), extras=listed(single)), encoding="utf-8")


def licences(*words: str) -> dict[str, str]:
    """Name -> licence of each package that ``pip install`` with these words brings."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        pip = ["-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", str(report)]
        subprocess.run([sys.executable, *pip, *words], check=True)
        installs = json.loads(report.read_text(encoding="utf-8"))["install"]
    return {normal(each["metadata"]["name"]): licence(each["metadata"]) for each in installs}


def licence(metadata: dict[str, Any]) -> str:
    """The expression, else the classifier, else the first line of the text."""
    kinds = [each.split(" :: ") for each in metadata.get("classifier", ())]
    classes = [kind[-1] for kind in kinds if kind[0] == "License" and len(kind) == 3]
    stated = metadata.get("license", "").strip().split("\n")[0]
    found = metadata.get("license_expression") or " or ".join(classes) or stated
    if not found:
        sys.exit(f"{metadata['name']} states no licence (or this pip is older than 25)")
    return SHORT.get(found, found)


def normal(name: str) -> str:
    """One spelling of a package's name."""
    return re.sub(r"[-_.]+", "-", name).lower()


def listed(found: dict[str, str]) -> str:
    """A line for each licence, with its packages."""
    by_licence = defaultdict(list)
    for name, kind in sorted(found.items()):
        by_licence[kind].append(name)
    return "\n".join(f"- {kind}: {', '.join(names)}." for kind, names in sorted(by_licence.items()))


if __name__ == "__main__":
    main()
