"""If the gyroscope misses a rotation, MoCap poses give the rate."""

from dataclasses import replace

from ekf_flights import feed, fly, GRAVITY
import numpy as np
import pytest

from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters

STRUCK = 3.0    # [s]
FAULTS = {
    'saturates at 1 rad/s': lambda rate: np.clip(rate, -1.0, 1.0),
    'x is dead': lambda rate: rate * [0, 1, 1],
    'bias of 2 rad/s about y': lambda rate: rate + [0, 2, 0],
}


@pytest.mark.parametrize('fault', FAULTS)
@pytest.mark.parametrize('seed', range(3))
def test_the_rate_follows_the_poses_if_the_gyroscope_misses_a_rotation(seed, fault):
    flight = fly(seed, 6.0, agility=2.0)
    flight.imu = [sample if sample.stamp < STRUCK else replace(
        sample, angular_velocity=FAULTS[fault](sample.angular_velocity)) for sample in flight.imu]
    ekf, found = ErrorStateEkf(EkfParameters.load(), GRAVITY), []
    for _, sample in flight.arrivals():
        feed(ekf, sample)
        if ekf.estimate is not None and ekf.estimate.stamp > STRUCK + 0.1:
            assert ekf.status == 'tracking'
            found.append(ekf.estimate)
    truth = flight.trajectory(np.array([e.stamp for e in found]))
    hidden = np.linalg.norm(FAULTS[fault](truth['rate']) - truth['rate'], axis=1)
    error = np.linalg.norm([e.angular_velocity for e in found] - truth['rate'], axis=1)
    assert hidden.max() > 1.0
    assert error.max() < 0.33 * hidden.max()
