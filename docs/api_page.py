"""The page of the Python API: every public name of taichi_mrf, in groups, from its docstring.

site.py adds the page; the plugin mkdocstrings replaces each ``:::`` block by the name's documentation.
"""

import importlib
import inspect
import re
import typing
from pathlib import Path

import taichi_mrf

GROUPS: dict[str, tuple[str, ...]] = {
    "Starting": ("init",),
    "Maps": ("MRFMap", "LogOddsMap", "VisibilityMap", "WavemapMap"),
    "Sensors": (
        "PinholeCamera",
        "DistortedCamera",
        "SphericalCamera",
        "RayTable",
        "PolynomialNoise",
        "PatchNoise",
        "sigma_of_confidence",
        "Frame",
    ),
    "Queries": (
        "UNKNOWN",
        "FREE",
        "OCCUPIED",
        "read_box",
        "slice_map",
        "cast_rays",
        "DistanceField",
        "find_frontiers",
        "view_gain",
        "compare_maps",
    ),
    "While it is made": ("live", "publish", "show"),
    "Another day": ("locate", "merge"),
    "Files": ("open_dataset", "load_map", "ChunkedMap", "take_part", "export_map", "ExportOptions"),
    "Evaluation": ("accuracy",),
    "Configuration": ("Config",),
    "Errors": ("TaichiMRFError",),
}
"""A new public name needs a place here, or the site is not built."""

INTRODUCTION = f"""# Python API

Everything on this page is imported from `taichi_mrf`; the examples write `import taichi_mrf as tm`.
`tm.__version__` is the version, {taichi_mrf.__version__} here. The examples, read from top to bottom, are
one program, which begins with

```python
import numpy as np

import taichi_mrf as tm
```

[Queries](queries.md) and [Parameters](parameters.md) explain more.
"""

RESULTS = """
## Results

The types that the functions and methods above return. Programs read them and do not construct them.
"""

OTHER_ERRORS = """
The other exceptions are in `taichi_mrf.errors`. All of them derive from `TaichiMRFError`.
"""


EXAMPLES = Path(__file__).with_name("api_examples.py")


def examples() -> dict[str, str]:
    """The section of EXAMPLES that shows each public name."""
    parts = re.split(r"^# ((?:tm\.\w+,? ?)+)$", EXAMPLES.read_text(encoding="utf-8"), flags=re.M)
    found = {}
    for names, code in zip(parts[1::2], parts[2::2], strict=True):
        *others, last = re.findall(r"\w+(?=,|$)", names)
        found |= dict.fromkeys(others, "") | {last: f"```python\n{code.strip()}\n```\n"}
    return found


def api_page() -> str:
    """The page as Markdown. Raises ValueError if GROUPS, EXAMPLES and the public names differ."""
    grouped = {name for names in GROUPS.values() for name in names}
    public = set(taichi_mrf.__all__) - {"__version__"}
    if grouped != public:
        raise ValueError(
            f"docs/api_page.py: GROUPS and taichi_mrf.__all__ differ: {sorted(grouped ^ public)}"
        )
    shown = examples()
    if set(shown) != public:
        raise ValueError(f"{EXAMPLES}: has not one section for each of: {sorted(set(shown) ^ public)}")
    parts = [INTRODUCTION]
    for title, names in GROUPS.items():
        parts.append(f"## {title}\n")
        for name in names:
            parts += [f"::: {_home(name)}.{name}\n", shown[name]]
    parts.append(OTHER_ERRORS)
    parts += [f"::: taichi_mrf.errors.{name}\n" for name in _other_errors()]
    parts.append(RESULTS)
    parts += [f"::: {module}.{name}\n" for module, name in _result_types()]
    return "\n".join(parts)


def _home(name: str) -> str:
    """The module that defines a public name; constants do not tell, so theirs is the one they come from."""
    home = getattr(getattr(taichi_mrf, name), "__module__", "")
    return home if home.startswith("taichi_mrf") else taichi_mrf._PUBLIC[name]


def _result_types() -> list[tuple[str, str]]:
    """Module and name of the package's classes that public functions and methods of MRFMap return."""
    public = [getattr(taichi_mrf, name) for name in taichi_mrf.__all__]
    methods = [each for name, each in inspect.getmembers(taichi_mrf.MRFMap) if not name.startswith("_")]
    returned = {
        typing.get_type_hints(each).get("return") for each in (*public, *methods) if inspect.isfunction(each)
    }
    classes = {each for each in returned if isinstance(each, type)} - set(filter(inspect.isclass, public))
    homes = {(each.__module__, each.__name__) for each in classes}
    return sorted(home for home in homes if home[0].startswith("taichi_mrf."))


def _other_errors() -> list[str]:
    base = taichi_mrf.TaichiMRFError
    return [
        name
        for name, each in vars(importlib.import_module("taichi_mrf.errors")).items()
        if isinstance(each, type) and issubclass(each, base) and each is not base
    ]
