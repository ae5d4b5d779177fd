"""The colours that the live page gets: none until they are asked for, then those of the map."""

from dataclasses import replace

import numpy as np
import pytest
from live_scene import CONFIG, FakeLink, finished, session_of

from taichi_mrf.queries.colored import shown_colors_in
from taichi_mrf.session.outbox import Outbox
from taichi_mrf.viewer.messages import BrickColors, Status, Switch, Watch
from taichi_mrf.voxels.layers import COLORS
from taichi_mrf.voxels.layout import grid_keys

pytestmark = pytest.mark.usefixtures("one_backend")

COLORED = replace(CONFIG, color=True)
PHOTO = Watch(images=False, view=None, baseline=False, colors=True)


def test_the_page_gets_the_colours_of_the_map_when_it_shows_them() -> None:
    link = FakeLink()
    session = session_of(link, config=COLORED)
    finished(session)
    assert not link.of_type(Status)[0].layers
    assert link.of_type(Status)[-1].layers == (COLORS,)
    assert not link.of_type(BrickColors)
    for edit in ((PHOTO,), (Switch(1, on=False),), (Switch(1, on=True),)):
        link.ask(*edit)
        m = finished(session)
        session._extras.work(lambda step: True)
        page = {}
        for update in link.of_type(BrickColors):
            assert (update.bricks // 8 == update.chunk).all()
            page |= dict(zip(grid_keys(update.bricks).tolist(), update.colors, strict=True))
        slots = m.view.pool.in_use
        wanted = shown_colors_in(m, slots)
        for key, colors in zip(grid_keys(m.view.pool.bricks[slots]).tolist(), wanted, strict=True):
            np.testing.assert_array_equal(page[key], colors)
        assert m.keyframes[max(m.keyframes)].color is not None
    sent = len(link.of_type(BrickColors))
    session._extras.work(lambda step: True)
    assert len(link.of_type(BrickColors)) == sent  # nothing has changed


def test_a_run_without_colours_has_none() -> None:
    link = FakeLink()
    session = session_of(link)
    link.ask(PHOTO)
    m = finished(session)
    session._extras.work(lambda step: True)
    assert not m.has_colors
    assert not link.of_type(Status)[-1].layers
    assert not link.of_type(BrickColors)


def test_later_colours_of_a_chunk_replace_waiting_ones() -> None:
    outbox, bricks = Outbox(), np.zeros((1, 3), np.int32)
    for number, chunk in enumerate([(0, 0, 0), (1, 0, 0), (0, 0, 0)]):
        outbox.put(BrickColors(chunk, bricks, np.full((1, 512, 3), number, np.uint8)))
    assert len(outbox) == 2
    assert {int(outbox.take().colors[0, 0, 0]) for _ in range(2)} == {1, 2}
