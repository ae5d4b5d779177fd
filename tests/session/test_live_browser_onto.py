"""A live run that goes on in the map of an earlier day, in a real Chromium: the page tells the days apart."""

from pathlib import Path

import pytest
from browser import Browser, LivePage, missing
from live_program import LiveProgram

from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.mapping.pipeline import map_sequence

YESTERDAY, TODAY = 12, 11
ROOM = "synthetic:room?frames={}&width=160&height=120"
CONFIG = Config(voxel_size=0.1, evaluation=EvaluationConfig(hold_out=0))

FRUSTA = """() => {
  const found = {};
  for (const [name, node] of Object.entries(window.__viserMutable.nodeRefFromName)) {
    if (!node || !/^.keyframes.[0-9]+$/.test(name)) continue;
    node.traverse(object => {
      if (!object.isLine2 && !object.isLineSegments2) return;
      found[name.split('/')[2]] = object.material.color.getHex();
    });
  }
  return found;
}"""
"""Colour of the frustum of each keyframe, by its number."""

PATH = """() => {
  let lines = -1;
  window.__viserMutable.nodeRefFromName['/path'].traverse(object => {
    if (object.isLineSegments2) lines = object.geometry.attributes.instanceStart.count;
  });
  return lines;
}"""
"""Number of lines of the camera's path."""

pytestmark = [
    pytest.mark.skipif(missing() is not None, reason=str(missing())),
    pytest.mark.usefixtures("one_backend"),
]


def test_the_page_says_how_surely_it_is_located_and_shows_the_days_apart(
    browser: Browser, tmp_path: Path
) -> None:
    map_sequence(open_dataset(ROOM.format(YESTERDAY), color=False), CONFIG).map.save(tmp_path / "map.npz")
    options = ("--onto", tmp_path / "map.npz", "--runtime.arch", "cpu")
    with (
        LiveProgram(ROOM.format(TODAY), *options) as program,
        LivePage(browser, program.address) as page,
    ):
        page.until(lambda seen: len(seen.keyframes) >= YESTERDAY + TODAY and seen.settled, "both days")
        page.tab("About")
        table = page.until(lambda seen: "located" in seen.table, "the tab About").table
        assert table["located"].endswith("% of what is seen agrees")
        assert table["located"].split(" cm, ")[0].isdigit()
        assert any(line.endswith(table["located"] + ".") for line in program.said)
        colors = page.page.evaluate(FRUSTA)
        assert page.page.evaluate(PATH) == YESTERDAY + TODAY - 2
        assert page.problems == []
    hues = [[colors[str(i)] >> shift & 255 for shift in (16, 8, 0)] for i in range(YESTERDAY + TODAY)]
    earlier, today = hues[:YESTERDAY], hues[YESTERDAY:]
    assert all(min(a - b for a, b in zip(old, new, strict=True)) > 0 for old in earlier[1:] for new in today)
