"""The figure of docs/architecture.md: the steps of its first table, and what three of them do on one ray.

site.py puts it in the place of the line ``<!-- way -->``. The boxes are the rows of the page's own table; the
curves are eqs. 4, 11, 13 and 14 on a ray through ten voxels. tests/docs/test_depth_way.py checks both.
"""

import math
import re
from dataclasses import dataclass
from html import escape

WIDTH, BOX, CELL, LEFT = 920, 112, 66, 170

PRIOR, MET = 0.1, 0.5
"""Cavity probability of occupied of the voxels, and of the one that other keyframes take for a surface."""

MEASURED, SIGMA = 6.4, 0.7
"""The measured depth and its standard deviation, in voxels from the beginning of the ray."""

FLOOR = 0.02
"""Likelihood of a measurement that no surface explains."""


@dataclass(frozen=True)
class Step:
    """A row of the table: its name, its equations and the functions that it names."""

    name: str
    equations: list[str]
    functions: list[tuple[str, str]]


@dataclass(frozen=True)
class RayMessages:
    """Of each voxel of a ray: m, nu and vis, and the log-odds that the ray sends it."""

    occupied: list[float]
    likelihood: list[float]
    visibility: list[float]
    message: list[float]


def steps(page: str) -> list[Step]:
    """The rows of the first table of a page whose first cell is a number and a name."""
    found = []
    for name, text in re.findall(r"^\| \d\. \*\*(\w+)\*\* \|(.*)\|$", page, re.MULTILINE):
        functions = re.findall(r"`([\w/]+\.py)`: `(\w+)`", text)
        found.append(Step(name, re.findall(r"\((\d+)\)", text), functions))
    return found


def messages(occupied: list[float]) -> RayMessages:
    """The sum-product of one ray in front of whose voxels nothing is known, each crossed in full length."""
    number = len(occupied)
    nu = [_normal(MEASURED - i - 1, MEASURED - i) for i in range(number)]
    vis, before, explained = [1.0], [0.0], []
    for m, likelihood in zip(occupied, nu, strict=True):
        explained.append(likelihood * m * vis[-1])  # eq. 11
        vis.append(vis[-1] * (1 - m))
        before.append(before[-1] + explained[-1])
    sent = []
    for i, m in enumerate(occupied):
        full = before[i] + nu[i] * vis[i] + FLOOR  # eq. 13
        empty = before[i] + sum(explained[i + 1 :]) / (1 - m) + FLOOR  # eq. 14
        sent.append(math.log(full / empty))
    return RayMessages(occupied, nu, vis[:number], sent)


def _normal(low: float, high: float) -> float:
    """Mass of the measurement's normal distribution between two deviations, in voxels."""
    scale = SIGMA * math.sqrt(2)
    return 0.5 * (math.erf(high / scale) - math.erf(low / scale))


def depth_way(page: str) -> str:
    """The figure as SVG, for the text of docs/architecture.md."""
    ray = messages([MET if i == int(MEASURED) else PRIOR for i in range(10)])
    return (
        f'<svg viewBox="0 0 {WIDTH} 400" role="img" '
        'aria-label="The steps of a depth image, and one ray of it through ten voxels">'
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path d="M0 0L8 4L0 8z" fill="#567"/></marker></defs>'
        '<g font-family="monospace" font-size="13" text-anchor="middle" fill="#123">'
        f"{_boxes(steps(page))}{_ray(ray)}</g></svg>"
    )


def _boxes(way: list[Step]) -> str:
    gap = (WIDTH - 4 - BOX * len(way)) / max(1, len(way) - 1)
    drawn = []
    for n, step in enumerate(way):
        x = 2 + n * (BOX + gap)
        numbers = "eq. " + ", ".join(step.equations) if step.equations else ""
        drawn.append(
            f'<rect x="{x:g}" y="2" width="{BOX}" height="46" rx="4" fill="#eef4f8" stroke="#567"/>'
            + _text(x + BOX / 2, 21, f"{n + 1}. {step.name}")
            + _text(x + BOX / 2, 39, numbers, 'font-size="11" fill="#567"')
        )
        if n:
            drawn.append(_arrow(x - gap + 1, 25, x - 1, 25))
    return "".join(drawn)


def _ray(ray: RayMessages) -> str:
    """Rows of cells and bars: cavity, forward, backward."""
    number = len(ray.occupied)
    right = LEFT + number * CELL
    drawn = [_label(110, "3. cavity", "m, dark: occupied")]
    for i, m in enumerate(ray.occupied):
        shade = round(245 - 190 * m)
        drawn.append(
            f'<rect x="{LEFT + i * CELL}" y="92" width="{CELL}" height="30" stroke="#9ab" '
            f'fill="rgb({shade},{shade},{shade})"/>'
        )
    drawn += [_label(190, "4. forward", "nu: bars, vis: line"), _arrow(LEFT, 236, right, 236)]
    drawn += [_bar(i, 226, 70 * nu, "#e0a030") for i, nu in enumerate(ray.likelihood)]
    line = " ".join(f"{LEFT + (i + 0.5) * CELL:g},{226 - 70 * v:.1f}" for i, v in enumerate(ray.visibility))
    drawn.append(f'<polyline points="{line}" fill="none" stroke="#2a6fb0" stroke-width="2"/>')
    drawn += [_label(310, "5. backward", "up: occupied, down: free"), _arrow(right, 376, LEFT, 376)]
    scale = 50 / max(abs(each) for each in ray.message)
    for i, each in enumerate(ray.message):
        drawn.append(_bar(i, 310, scale * each, "#b8403a" if each > 0 else "#4a9a60"))
    drawn.append(f'<path d="M{LEFT} 310H{right}" stroke="#9ab"/>')
    x = LEFT + MEASURED * CELL
    drawn.append(f'<path d="M{x:g} 82V366" stroke="#567" stroke-dasharray="4 4"/>')
    drawn.append(_text(x, 76, "measured depth"))
    return "".join(drawn)


def _bar(i: int, base: float, height: float, color: str) -> str:
    top = base - max(height, 0.0)
    x = LEFT + i * CELL + 14
    return f'<rect x="{x}" y="{top:.1f}" width="{CELL - 28}" height="{abs(height):.1f}" fill="{color}"/>'


def _label(y: float, name: str, meaning: str) -> str:
    small = 'font-size="11" fill="#567"'
    return _text(LEFT / 2 - 4, y, name) + _text(LEFT / 2 - 4, y + 17, meaning, small)


def _arrow(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line x1="{x1:g}" y1="{y1:g}" x2="{x2:g}" y2="{y2:g}" stroke="#567" marker-end="url(#tip)"/>'


def _text(x: float, y: float, text: str, style: str = "") -> str:
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(text)}</text>'
