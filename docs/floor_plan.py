"""The figure and the table of packages in docs/architecture.md, made from docs/floors.yaml.

site.py puts them in the place of the line ``<!-- floors -->``. The same file is what tests/test_floors.py
holds the code to, so the page cannot disagree with the imports.
"""

from html import escape
from pathlib import Path
from typing import Any

import yaml

FLOORS = Path(__file__).with_name("floors.yaml")

Floors = dict[str, dict[str, Any]]

WIDTH, BOX_HEIGHT, FLOOR_HEIGHT, GAP = 920, 28, 62, 12


def floor_plan() -> str:
    """The figure and the table as Markdown."""
    floors: Floors = yaml.safe_load(FLOORS.read_text(encoding="utf-8"))
    rows = [
        f"| `{name}/` | {floor['about']} |" for name, floor in reversed(floors.items()) if name != "errors"
    ]
    table = ["| package | what it holds |", "| --- | --- |", *rows]
    return f"<div>{figure(floors)}</div>\n\n" + "\n".join(table)


def figure(floors: Floors) -> str:
    """An SVG: a box for each package above all that it uses, a line for each use that no other implies."""
    height: dict[str, int] = {}
    for name, floor in floors.items():
        height[name] = 1 + max((height[used] for used in floor["uses"]), default=-1)
    top = max(height.values())
    middle: dict[str, tuple[float, float]] = {}
    boxes = []
    for level in range(top + 1):
        names = [name for name in floors if height[name] == level and name != "errors"]
        widths = [8 * len(name) + 18 for name in names]
        left = (WIDTH - sum(widths) - 3 * GAP * (len(names) - 1)) / 2
        y = (top - level) * FLOOR_HEIGHT + 2
        for name, width in zip(names, widths, strict=True):
            middle[name] = left + width / 2, y + BOX_HEIGHT / 2
            boxes.append(
                f'<rect x="{left:g}" y="{y}" width="{width}" height="{BOX_HEIGHT}" rx="4"/>'
                f'<text fill="#123" stroke="none" x="{left + width / 2:g}" y="{y + 19}">{escape(name)}</text>'
            )
            left += width + 3 * GAP
    lines = [
        '<line x1="{:g}" y1="{:g}" x2="{:g}" y2="{:g}"/>'.format(*middle[name], *middle[used])
        for name in middle
        for used in direct_uses(floors, name)
    ]
    return (
        f'<svg viewBox="0 0 {WIDTH} {(top + 1) * FLOOR_HEIGHT}" role="img" '
        'aria-label="The packages of taichi_mrf, each above the packages that it uses">'
        f'<g stroke="#9ab" stroke-width="1">{"".join(lines)}</g>'
        '<g fill="#eef4f8" stroke="#567" font-family="monospace" font-size="13" text-anchor="middle">'
        f"{''.join(boxes)}</g></svg>"
    )


def direct_uses(floors: Floors, name: str) -> list[str]:
    """The packages that a package uses and that no other of its packages uses."""
    uses = floors[name]["uses"]
    implied = {deeper for used in uses for deeper in all_uses(floors, used)}
    return [used for used in uses if used not in implied and used != "errors"]


def all_uses(floors: Floors, name: str) -> set[str]:
    """Packages that a package uses, directly or through others."""
    uses = set(floors[name]["uses"])
    return uses.union(*(all_uses(floors, used) for used in uses))
