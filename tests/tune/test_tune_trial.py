"""The headless core: which frames do what, and scores that are those of the judge itself."""

import dataclasses

import numpy as np
import pytest
from inputs_frames import of_frames
from tune_scene import CHOICE, CONFIG, room, working_set

from taichi_mrf.config.schema import KeyframeConfig, SensorConfig
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.evaluation.accuracy import OUTLIERS, judge_view
from taichi_mrf.evaluation.depth_intervals import interval_error, probability_below
from taichi_mrf.evaluation.held_out import pooled_depth_error
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import create_map
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.tune.held_out_pictures import residuals_of
from taichi_mrf.tune.trial import run_trial
from taichi_mrf.tune.working_set import coarse_stride, read_working_set, thinned
from taichi_mrf.viewer.tune.messages import FrameChoice


def names(frames: tuple[Frame, ...]) -> list[str]:
    return [frame.name for frame in frames]


def built(frames: tuple[Frame, ...]) -> OccupancyMap:
    m = create_map(CONFIG, room().camera)
    for frame in frames:
        m.add_keyframe(frame.depth_m, frame.T_world_camera, frame.camera, frame.name)
    m.infer()
    return m


def test_every_third_frame_is_held_out_and_every_second_of_these_kept_back() -> None:
    frames = working_set()
    assert names(frames.training) == [f"room-{i:04d}" for i in (0, 2, 3, 5, 6, 8)]
    assert names(frames.held_out) == ["room-0001", "room-0007"]
    assert names(frames.unseen) == ["room-0004"]
    by_hand = read_working_set(room(), CHOICE)
    assert names(by_hand.held_out) == ["room-0001", "room-0004", "room-0007"]
    assert by_hand.unseen == ()


def test_frames_are_spread_over_the_sequence_unless_told() -> None:
    assert read_working_set(room(), FrameChoice(count=4, hold_out=2)).choice.stride == 2
    chosen = read_working_set(room(), FrameChoice(first=2, stride=3, count=3))
    assert names(chosen.training) == ["room-0002", "room-0008"]


def test_a_broken_frame_is_left_out_and_named() -> None:
    frames = read_working_set(of_frames(list(room()), broken={0}), CHOICE)
    assert len(frames.training) == 5
    assert frames.skipped == ("room-0000: the image is damaged",)
    with pytest.raises(DatasetError, match=r"no training frame.*room-0000: the image is damaged"):
        read_working_set(of_frames(list(room()), broken={0, 2}), FrameChoice(stride=1, count=3))


def test_a_choice_outside_the_sequence_is_refused() -> None:
    with pytest.raises(ConfigError, match="between 0 and 8, not 9"):
        read_working_set(room(), FrameChoice(first=9))
    with pytest.raises(ConfigError, match="hold_out must be at least 2"):
        FrameChoice(hold_out=1)


def test_scores_are_those_of_the_judge() -> None:
    frames = working_set()
    trial = run_trial(CONFIG, frames)
    assert trial is not None
    m = built(frames.training)
    views = [judge_view(m, f.depth_m, f.T_world_camera, f.camera, noise=m.noise) for f in frames.held_out]
    pixels = [int(view.judged.sum()) for view in views]
    for name, tolerance in (
        ("accuracy_voxel", "voxel"), ("accuracy_sigma", "1.5sigma"), ("accuracy_5cm", "5cm"),
    ):  # fmt: skip
        expected = np.average([view.accuracy(tolerance).score for view in views], weights=pixels)
        assert getattr(trial.scores, name) == pytest.approx(expected)
    error = pooled_depth_error((view.answer_m, view.depth_m) for view in views)
    assert trial.scores.median_abs_m == error.median_abs
    assert trial.scores.rms_m == error.rms
    likelihood = np.average([view.log_likelihood() for view in views], weights=pixels)
    assert trial.scores.log_likelihood == pytest.approx(likelihood)
    assert trial.scores.voxels == m.statistics().voxels
    assert trial.scores.keyframes == 6
    assert 0 < trial.scores.voxel_calibration < 0.3


def test_a_map_of_a_biased_sensor_is_judged_by_surfaces() -> None:
    config = dataclasses.replace(CONFIG, sensor=SensorConfig(bias=(0.05,)))
    trial = run_trial(config, working_set())
    assert trial is not None
    for view, frame in zip(trial.views, working_set().held_out, strict=True):
        measured = frame.depth_m > 0
        assert np.array_equal(view.measured_m, frame.depth_m)
        np.testing.assert_allclose(view.depth_m[measured], frame.depth_m[measured] - 0.05, atol=1e-6)


def test_keyframe_thresholds_choose_among_the_training_frames() -> None:
    config = dataclasses.replace(CONFIG, keyframes=KeyframeConfig(translation=2.0))
    trial = run_trial(config, working_set())
    assert trial is not None
    assert 1 <= trial.scores.keyframes < 6
    assert len(trial.map.keyframes) == trial.scores.keyframes


def test_a_thinned_frame_measures_at_every_so_many_th_pixel() -> None:
    frame = working_set().training[0]
    small = thinned(frame, 4).depth_m
    assert np.array_equal(small[2::4, 2::4], frame.depth_m[2::4, 2::4])
    small = small.copy()
    small[2::4, 2::4] = 0
    assert not small.any()
    assert thinned(frame, 1) is frame
    wide = dataclasses.replace(frame.camera, width=640, height=480)
    assert (coarse_stride(frame.camera), coarse_stride(wide)) == (1, 4)


def test_a_coarse_look_judges_the_thinned_pixels_only() -> None:
    trial = run_trial(CONFIG, working_set(), pixel_stride=3)
    assert trial is not None
    assert trial.scores.pixel_stride == 3
    for view, frame in zip(trial.views, working_set().held_out, strict=True):
        assert view.judged.sum() == (thinned(frame, 3).depth_m > 0).sum()
    for keyframe in trial.map.keyframes.values():
        assert keyframe.rays <= -(-80 // 3) * -(-60 // 3)


def test_a_try_that_is_not_wanted_any_more_ends_between_two_keyframes() -> None:
    for last in (1, 4, 10):
        asked: list[str] = []

        def go_on(activity: str, share: float, last: int = last, asked: list[str] = asked) -> bool:
            assert 0 <= share <= 1
            asked.append(activity)
            return len(asked) < last

        assert run_trial(CONFIG, working_set(), go_on=go_on) is None
        assert len(asked) == last


def test_a_maps_warning_comes_with_the_try() -> None:
    config = dataclasses.replace(CONFIG, sensor=SensorConfig(sigma=(-0.01,)))
    trial = run_trial(config, working_set())
    assert trial is not None
    assert len(trial.warnings) == 1
    assert "sigma of the polynomial falls to" in trial.warnings[0]


@pytest.mark.parametrize("method", ["mrf", "log_odds"])
def test_the_predicted_distribution_is_that_of_the_log_likelihood(method: str) -> None:
    """Its distribution function is the integral of the density that the judge takes the logarithm of."""
    config = dataclasses.replace(
        CONFIG, method=method, sensor=SensorConfig(sigma=(0.03, 0.0, 0.004), bias=(0.02,))
    )
    trial = run_trial(config, working_set())
    assert trial is not None
    m, frame = trial.map, working_set().held_out[0]
    chosen = np.zeros(frame.camera.shape, bool)
    chosen[5::20, 5::20] = frame.depth_m[5::20, 5::20] > 0
    table = m.noise.table(frame.camera)
    most, step = m.sensor.max_depth, 0.005
    middles = np.arange(0.5 * step, most, step)
    density = np.zeros((len(middles), int(chosen.sum())))
    for row, z in zip(density, middles, strict=True):
        image = np.where(chosen, np.float32(z), np.float32(0))
        survey = m.view.survey(frame.camera, frame.T_world_camera, most, image, table, predicting=True)
        through = survey.visibility[chosen] / most
        row[:] = (1 - OUTLIERS) * (survey.likelihood[chosen] + through) + OUTLIERS / most
    distribution = np.cumsum(density, axis=0) * step
    measured = np.where(chosen, frame.depth_m, np.float32(0))
    below = probability_below(m.view, measured, frame.T_world_camera, frame.camera, table, most)
    at = [np.interp(z, middles + 0.5 * step, column) for z, column in zip(
        frame.depth_m[chosen], distribution.T, strict=True)]  # fmt: skip
    assert below == pytest.approx(np.array(at), abs=5e-3)
    assert below.std() > 0.05


def test_the_interval_error_is_zero_for_even_and_large_for_sure_predictions() -> None:
    even = np.linspace(0, 1, 4001, dtype=np.float32)
    assert interval_error([even[::2], even[1::2]]) < 2e-3
    assert interval_error([np.zeros(100, np.float32)]) == pytest.approx(0.5)
    assert interval_error([np.full(100, 0.5, np.float32)]) == pytest.approx(0.5)
    assert np.isnan(interval_error([]))


def test_residuals_are_measured_minus_expected() -> None:
    trial = run_trial(CONFIG, working_set())
    assert trial is not None
    found = residuals_of(3, trial.views)
    assert found.number == 3
    assert (np.diff(found.depth_m) >= 0).all()
    view = trial.views[0]
    pairs = {
        (expected, np.float32(measured - expected))
        for each in trial.views
        for expected, measured in zip(each.survey.expected.flat, each.measured_m.flat, strict=True)
    }
    assert set(zip(found.depth_m, found.residual_m, strict=True)) <= pairs
    every = np.concatenate([
        (v.measured_m - v.survey.expected)[v.measured & v.answered] for v in trial.views
    ])  # fmt: skip
    assert found.median_m.min() <= np.median(every) <= found.median_m.max()
    assert (found.spread_m > 0).all()
    assert view.measured.any()
