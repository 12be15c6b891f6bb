"""Diagnostics: quantiles in constant memory, missed targets of the motor board."""

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from beetle_omni_ros.drivers.motor_board import Sent
from beetle_omni_ros.nodes.node import Distribution
from beetle_omni_ros.nodes.rotor_bridge_node import TargetStream


def test_quantiles_agree_with_sorting_within_two_percent():
    distribution = Distribution()
    assert np.isnan(distribution.quantile(0.5))
    samples = 1e-3 * np.exp(np.random.default_rng(1).normal(0, 2.0, 5000))
    for sample in samples:
        distribution.add(float(sample))
    for fraction in (0.5, 0.9, 0.99):
        assert distribution.quantile(fraction) == pytest.approx(
            np.quantile(samples, fraction), rel=0.02)
    assert distribution.max == samples.max() and distribution.count == 5000


def sent(saturated=(False,) * 4, reason=''):
    return Sent(reason, np.array(saturated), np.full(4, 0.5))


@pytest.mark.parametrize(('gaps', 'cycles', 'missed'), [
    ([0.007, 0.003, 0.0051], 3, 0),     # nearer to one period than to two
    ([0.005, 0.0076, 0.005], 4, 1),
    ([0.005, 0.021, 0.005], 6, 3),
    ([0.001, 0.0, 0.004], 1, 0)])
def test_a_period_without_a_target_is_missed(gaps, cycles, missed):
    stream = TargetStream(0.005)
    for now in 100 + np.cumsum([0.0, *gaps]):
        stream.add(sent(), now)
    assert (stream.cycles, stream.missed) == (cycles, missed)


def test_a_full_buffer_counts_as_missed_and_rest_does_not_and_saturation_is_by_rotor():
    stream = TargetStream(0.005)
    stream.add(sent(), 1.0)
    stream.rest()
    stream.add(sent((False, True, False, True)), 2.0)
    assert (stream.cycles, stream.missed) == (0, 0)
    stream.add(sent(reason='buffer full'), 2.005)
    stream.add(sent((False, True, False, False)), 2.010)
    assert stream.missed == 1 and stream.unsent == {'buffer full': 1}
    assert stream.saturated.tolist() == [0, 2, 0, 1]
