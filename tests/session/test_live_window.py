"""A live run of a map with a window: what the map freezes itself is frozen on the page too."""

from pathlib import Path

import numpy as np
import pytest
from window_walk import add, windowed

from taichi_mrf.mapping.intake import Added
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.session.extras import BaselineOverlay
from taichi_mrf.session.mapper import MOST_FROZEN, LiveKeyframes, Mapper

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


def test_a_run_of_all_day_remembers_a_bounded_part_of_its_path() -> None:
    roster, camera = LiveKeyframes(), PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0)
    picture, count = np.zeros((3, 4, 3), np.uint8), 5 * MOST_FROZEN
    for number in range(count):
        frame = Frame(np.ones((3, 4), np.float32), np.eye(4), camera, float(number), str(number), None)
        entry = roster.add(frame, 12, (camera, picture), number, float(number))
        if number % 100:
            roster.freeze(entry)
            assert roster.with_state("frozen")[-1] is entry or number % 97
    stamps = [entry.stamp_s for entry in roster.with_state("frozen")]
    assert roster.frozen == count - count // 100
    assert MOST_FROZEN // 2 <= len(stamps) <= MOST_FROZEN
    assert (stamps[0], stamps[-1]) == (1.0, count - 1.0)  # the span of time that the page can show
    assert max(np.diff(stamps)) <= 10  # the path is as dense at its beginning as at its end
    # All that can be changed is there.
    assert [entry.id for entry in roster.with_state("on")] == list(range(0, count, 100))
