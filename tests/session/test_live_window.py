"""A live run of a map with a window: what the map freezes itself is frozen on the page too."""

from pathlib import Path

import pytest
from window_walk import add, windowed

from taichi_mrf.mapping.intake import Added
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.extras import BaselineOverlay
from taichi_mrf.session.mapper import Mapper

pytest.importorskip("zarr", reason="a window needs the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")


def test_keyframes_outside_the_window_are_frozen_on_the_page(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    mapper, told = Mapper(m), []
    for number, place_m in enumerate([0.0, 0.5, 3.0, 3.5, 9.0]):
        id = add(m, place_m, number)
        keyframe = m.keyframes[id]
        frame = Frame(keyframe.depth_m, keyframe.T_world_camera, keyframe.camera, 0.1, keyframe.name, None)
        mapper.enter(Added(frame, id, keyframe.rays))
        told.append([info.name for info in mapper.left_behind()])
        mapper.renew()
        mapper.shown.publisher.changes()
    names = [entry.name for entry in mapper.roster.entries.values()]
    assert told == [[], [], names[:2], [], names[2:4]]
    assert mapper.left_behind() == []
    assert [entry.map_id for entry in mapper.roster.with_state("on")] == list(m.keyframes)
    assert [entry.name for entry in mapper.roster.with_state("frozen")] == names[:4]
    # What has left memory is taken off the page.
    assert len(mapper.shown.publisher._sent.bricks()) == m.statistics().bricks


def test_the_baseline_has_no_window(tmp_path: Path) -> None:
    m = windowed(tmp_path / "far.zarr")
    assert BaselineOverlay(m.config, m.noise).map.config.volume.window_m == 0
