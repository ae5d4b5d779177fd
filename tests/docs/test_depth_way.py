"""The way of a depth image on the page about the architecture: its table names functions that compute the
equations which it states; its figure has all steps, and the messages that the equations give."""

import ast
import re
import sys
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "docs"))

from depth_way import FLOOR, Step, depth_way, messages, steps  # noqa: E402

PAGE = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")


def source_of(path: str, name: str) -> str:
    """The text of a function, with its comments."""
    text = (REPOSITORY / "taichi_mrf" / path).read_text(encoding="utf-8")
    found = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef) and n.name == name]
    assert len(found) == 1, f"{name} stands {len(found)} times in {path}"
    return ast.get_source_segment(text, found[0]) or ""


@pytest.mark.parametrize("step", steps(PAGE), ids=lambda step: step.name)
def test_the_functions_of_a_step_name_its_equations(step: Step) -> None:
    code = "".join(source_of(*function) for function in step.functions)
    phrases = re.findall(r"[Ee]qs?\. (\d+(?:(?:,| and|, and) \d+)*)", code)
    named = {number for phrase in phrases for number in re.findall(r"\d+", phrase)}
    assert code
    assert not set(step.equations) - named


def test_the_figure_shows_every_step_in_order() -> None:
    way, figure = steps(PAGE), depth_way(PAGE)
    assert len(way) == 7
    places = [figure.index(f">{n}. {step.name}</text>") for n, step in enumerate(way, start=1)]
    assert places == sorted(places)


def test_the_messages_in_the_figure_are_the_marginals_of_the_ray() -> None:
    occupied = [0.1, 0.3, 0.05, 0.2, 0.1, 0.4, 0.5, 0.2]
    ray = messages(occupied)
    odds: dict[tuple[int, int], float] = {}
    for bits in range(2 ** len(occupied)):
        states = [bits >> i & 1 for i in range(len(occupied))]
        first = states.index(1) if 1 in states else None
        density = FLOOR + (0.0 if first is None else ray.likelihood[first])
        for i, state in enumerate(states):
            chances = [m if s else 1 - m for m, s in zip(occupied, states, strict=True)]
            others = float(np.prod(chances[:i] + chances[i + 1 :]))
            odds[i, state] = odds.get((i, state), 0.0) + density * others
    exact = [np.log(odds[i, 1] / odds[i, 0]) for i in range(len(occupied))]
    assert ray.message == pytest.approx(exact, abs=1e-12)
