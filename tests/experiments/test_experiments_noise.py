"""`eval noise`: who is judged under which noise, on a small room with the noise file of a better sensor."""

from pathlib import Path

import numpy as np
import pytest
import small_room

from taichi_mrf import PolynomialNoise
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.experiments import noise
from taichi_mrf.experiments.folds import Experiment
from taichi_mrf.experiments.learnt_noise import frames_of
from taichi_mrf.experiments.ledger import Ledger
from taichi_mrf.experiments.noise_scenes import NoiseCase, cases
from taichi_mrf.experiments.scenes import Scene, SceneView
from taichi_mrf.sensor.simulate import KINECT_1

pytestmark = pytest.mark.usefixtures("one_backend")


def room(factor: float) -> Scene:
    """Ten views, whose noise file is off by a factor."""
    views = [
        SceneView(f.name, f.T_world_camera, f.depth_m, f.depth_m, f.depth_m > 0) for f in small_room.frames()
    ]
    sigma = tuple(factor * c for c in KINECT_1.sigma)
    return Scene("room", small_room.frames()[0].camera, PolynomialNoise(sigma), VolumeConfig(), 10.0, views)


def test_every_case_holds_out_other_views_than_it_maps() -> None:
    for case in cases():
        keyframes, held_out = case.split(room(1.0))
        assert sorted(keyframes + held_out) == list(range(10))
        assert keyframes
        assert held_out
    assert len({case.name for case in cases()}) == len(cases())


def test_views_become_frames_that_state_the_scene_s_noise() -> None:
    scene = room(2.0)
    frames = frames_of(scene, [4, 1])
    assert list(frames.frame_names) == [scene.views[4].name, scene.views[1].name]
    frame = frames.read(1)
    np.testing.assert_array_equal(frame.depth_m, scene.views[1].measured_m)
    assert frame.noise is scene.noise


def test_all_maps_are_judged_under_both_noises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = NoiseCase("room", (0.05,), False, lambda e: room(0.1), slice(1, None, 3))
    monkeypatch.setattr(noise, "cases", lambda: [case])
    ledger = Ledger(tmp_path / "noise.jsonl", {})
    experiment = Experiment(tmp_path, tmp_path, ledger, (0.05,), (0,))
    (table,), paths = noise.run_noise(experiment)
    assert all(path.exists() for path in paths)
    rows = {row[2]: dict(zip(table.columns[3:], row[3:], strict=True)) for row in table.rows}
    assert len(rows) == 6
    for name in (noise.GIVEN, noise.AUTO):  # a noise file that is off by ten loses to the learnt one
        given, learnt = (rows[name][f"log-likelihood, {which} noise"] for which in ("given", "learnt"))
        assert given.mean < learnt.mean
    computed = ledger.computed
    again, _ = noise.run_noise(experiment)
    assert ledger.computed == computed
    assert repr(again) == repr([table])
    with pytest.raises(ConfigError, match="--only leaves none of: room"):
        noise.run_noise(Experiment(tmp_path, tmp_path, ledger, (0.05,), (0,), only=("kitchen",)))
