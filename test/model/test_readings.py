"""The filter of IMU spikes: errors are held back, impacts pass."""

import numpy as np

from beetle_omni_ros.model.readings import LONGEST_HELD, SpikeFilter

LEVEL, REST = np.array([0.0, 0.0, 9.81]), np.zeros(3)


def used(readings):
    """Which of the readings (force, rate) pass a filter that has seen rest, and how it ended."""
    checked = SpikeFilter()
    assert checked.passes(LEVEL, REST)
    return [checked.passes(*reading) for reading in readings], checked


def test_independent_errors_in_a_row_rarely_pass():
    random, confirmed = np.random.default_rng(0), 0
    for _ in range(1000):
        errors = random.normal(size=(2, 6))
        errors *= 3 / np.linalg.norm(errors, axis=1, keepdims=True)
        passed, _ = used([(LEVEL + 30 * error[:3], REST + 3 * error[3:]) for error in errors])
        assert not passed[0]
        confirmed += passed[1]
    assert confirmed < 70       # 5 % of 1000, and three standard deviations


def test_an_impact_that_fades_passes_with_its_second_reading():
    passed, checked = used([(LEVEL * 20, np.array([4.0, 0, 0])),
                            (LEVEL * 8, np.array([6.0, 1, 0]))])
    assert passed == [False, True]
    assert checked.passes(LEVEL * 8, np.array([6.0, 1, 0]))


def test_readings_that_go_on_jumping_are_not_held_back_for_ever():
    sign = np.resize([1, -1], LONGEST_HELD + 1)
    passed, checked = used([(LEVEL + 90 * s, REST) for s in sign])
    assert passed == [False] * LONGEST_HELD + [True]
