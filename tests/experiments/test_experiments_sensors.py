"""``eval sensors`` on a few places of the corridor, with small images."""

from pathlib import Path

import numpy as np
import pytest
from small_scenes import experiment

from taichi_mrf.errors import ConfigError
from taichi_mrf.experiments import sensors

pytestmark = pytest.mark.usefixtures("one_backend")

SMALL = "synthetic:corridor?rooms=2&frames=80&width=80&height=60&noise=none"


def test_both_sensors_together_beat_either(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "SCENE", SMALL)
    options = {"voxel_sizes": (0.1,), "seeds": (0,), "limit": 9}
    chosen = experiment(tmp_path, tmp_path / "out", **options)
    (table,), paths = sensors.run_sensors(chosen)
    camera, lidar, both, in_turn = table.rows
    assert [row[1] for row in table.rows] == ["camera", "lidar", "both", "both in turn"]
    for ahead, around in ((2, 3), (4, 5)):
        better = 1 if ahead == 2 else -1
        for alone in (camera, lidar):
            assert better * both[ahead].mean >= better * alone[ahead].mean
            assert better * both[around].mean >= better * alone[around].mean
    assert both[7] > max(camera[7], lidar[7])
    assert all(row[6] < row[7] <= 1 for row in table.rows)
    assert in_turn[2].mean > lidar[2].mean
    assert table.notes[-1].startswith("7 places, 2 held out.")
    assert {path.suffix for path in paths} == {".csv", ".tex", ".png"}
    before = len(chosen.ledger.done)
    again, _ = sensors.run_sensors(chosen)
    assert again[0].rows == table.rows
    assert len(chosen.ledger.done) == before


def test_the_two_sensors_measure_one_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "SCENE", SMALL)
    robot = sensors.drive(0, 4)
    image, scan = robot.taken[1]
    assert len(robot.images(sensors.BY_BOTH)) == 2 * len(robot.taken) == 6
    assert [each.camera for each in robot.images(sensors.IN_TURN)] == [
        image.camera,
        sensors.LIDAR,
        image.camera,
    ]
    assert image.depth_m.max() < 4.2
    # The lidar stands upright above the camera and looks the same way.
    np.testing.assert_allclose(scan.T_world_camera[:3, 3] - image.T_world_camera[:3, 3], [0, 0, 0.3])
    np.testing.assert_allclose(scan.T_world_camera[:3, 2], [0, 0, 1])
    assert scan.T_world_camera[:3, 0] @ image.T_world_camera[:3, 2] > 0.9
    # A view around begins with the robot's own heading, level.
    (first, _), *_ = robot.around
    assert abs(first[2, 2]) < 1e-9
    with pytest.raises(ConfigError, match="2 views; the experiment needs at least 3"):
        sensors.drive(0, 2)
