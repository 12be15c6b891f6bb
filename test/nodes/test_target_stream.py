"""Missed periods of the motor board's targets."""

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from beetle_omni_ros.drivers.motor_board import Sent
from beetle_omni_ros.nodes.rotor_bridge_report import TargetStream

PERIOD = 0.005
NONE = np.zeros(4, dtype=bool)


def sent(saturated=NONE, reason=''):
    return Sent(reason, np.array(saturated), np.full(4, 0.5))


@pytest.mark.parametrize(('gaps', 'cycles', 'missed'), [
    ([0.005] * 10, 10, 0),
    ([0.007, 0.003, 0.0051], 3, 0),     # nearer to one period than to two
    ([0.005, 0.0076, 0.005], 4, 1),
    ([0.005, 0.021, 0.005], 6, 3),
    ([0.001, 0.0, 0.004], 1, 0)])
def test_a_period_without_a_target_is_missed(gaps, cycles, missed):
    stream = TargetStream(PERIOD)
    for now in 100 + np.cumsum([0.0, *gaps]):
        stream.add(sent(), now)
    assert (stream.cycles, stream.missed) == (cycles, missed)


def test_a_full_buffer_counts_as_missed_and_rest_does_not():
    stream = TargetStream(PERIOD)
    stream.add(sent(), 1.0)
    stream.rest()
    stream.add(sent(), 2.0)
    assert (stream.cycles, stream.missed) == (0, 0)
    stream.add(sent(reason='buffer full'), 2.005)
    stream.add(sent(), 2.010)
    assert stream.missed == 1 and stream.unsent == {'buffer full': 1}


def test_saturation_is_counted_for_each_rotor():
    stream = TargetStream(PERIOD)
    for saturated in ([0, 1, 0, 1], [0, 1, 0, 0]):
        stream.add(sent(np.array(saturated, dtype=bool)), 1.0)
    assert stream.saturated.tolist() == [0, 2, 0, 1]
