"""Turns from angular rates: exact for a constant rate, and unknown where samples are missing."""

import cv2
import numpy as np
import pytest

from taichi_mrf.sensor.motion import LARGEST_GAP_S, GyroSamples

RATE = np.array([0.4, -1.1, 0.7])


def samples(seconds: float = 1.0, hz: float = 100.0, rate: np.ndarray = RATE) -> GyroSamples:
    stamps = np.arange(0.0, seconds + 0.5 / hz, 1 / hz)
    return GyroSamples(stamps, np.broadcast_to(rate, (len(stamps), 3)))


def test_a_constant_rate_gives_the_exact_turn() -> None:
    bias = np.array([0.02, 0.01, -0.03])
    for begin, end in ((0.1, 0.3), (0.1234, 0.1237), (0.0, 1.0), (-0.01, 1.02)):
        R = samples().turn(begin, end)
        assert R is not None
        np.testing.assert_allclose(R, cv2.Rodrigues(RATE * (end - begin))[0], atol=1e-12)
        corrected = samples(rate=RATE + bias).turn(begin, end, bias)
        assert corrected is not None
        np.testing.assert_allclose(corrected, R, atol=1e-12)


def test_a_turn_is_that_of_its_parts_and_takes_points_back() -> None:
    gyro = samples()
    whole, first, second = (gyro.turn(*times) for times in ((0.2, 0.8), (0.2, 0.5), (0.5, 0.8)))
    assert whole is not None
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first @ second, whole, atol=1e-12)
    # A camera that turns to the right, about y downwards, has what was ahead on its left afterwards.
    right = samples(rate=np.array([0.0, 0.5, 0.0])).turn(0.0, 0.2)
    assert right is not None
    assert (right.T @ [0.0, 0.0, 1.0])[0] < 0


def test_a_rate_that_changes_is_integrated_to_second_order() -> None:
    errors = []
    for hz in (50.0, 100.0):
        stamps = np.arange(0.0, 1.0 + 0.5 / hz, 1 / hz)
        gyro = GyroSamples(stamps, np.stack([np.zeros_like(stamps), np.sin(6 * stamps), 0 * stamps], axis=1))
        R = gyro.turn(0.0, 1.0)
        assert R is not None
        errors.append(np.abs(R - cv2.Rodrigues(np.array([0.0, (1 - np.cos(6.0)) / 6, 0.0]))[0]).max())
    assert errors[1] < 0.3 * errors[0] < 1e-4


@pytest.mark.parametrize(
    ("begin", "end"), [(0.3, 0.3), (0.5, 0.4), (-0.2, 0.3), (0.8, 1.0 + 1.2 * LARGEST_GAP_S), (2.0, 3.0)]
)
def test_a_turn_that_was_not_measured_is_unknown(begin: float, end: float) -> None:
    assert samples().turn(begin, end) is None


def test_a_gap_between_samples_is_not_bridged() -> None:
    whole = samples()
    there = (whole.stamps_s < 0.4) | (whole.stamps_s > 0.5)
    gappy = GyroSamples(whole.stamps_s[there], whole.rates_rad_s[there])
    assert gappy.turn(0.3, 0.6) is None
    assert gappy.turn(0.45, 0.46) is None
    assert gappy.turn(0.1, 0.35) is not None
    assert gappy.turn(0.6, 0.9) is not None
    assert GyroSamples(np.zeros(0), np.zeros((0, 3))).turn(0.0, 0.1) is None
