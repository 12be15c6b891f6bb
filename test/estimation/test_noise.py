"""The noise of the MoCap, estimated from its poses."""

from ekf_flights import fly, Sensors
import numpy as np
import pytest

from beetle_omni_ros.estimation.noise import NoiseMonitor
from beetle_omni_ros.estimation.parameters import MocapParameters


def scale_after(poses):
    """Feed poses to a monitor with the default noise."""
    monitor = NoiseMonitor(MocapParameters())
    for pose in poses:
        monitor.add(pose.stamp, pose.position, pose.quaternion)
    return np.array(monitor.scale)


@pytest.mark.parametrize('sensors', [Sensors(), Sensors.perfect()])
def test_noise_up_to_its_parameter_is_not_rescaled(sensors):
    assert np.array_equal(scale_after(fly(1, 5.0, sensors).poses), [1.0, 1.0])


@pytest.mark.parametrize('position, orientation', [(5.0, 1.0), (1.0, 4.0)])
def test_excess_noise_is_estimated_for_each_measurement_kind(position, orientation):
    claim = MocapParameters()
    sensors = Sensors(position_noise=position * claim.position_noise,
                      orientation_noise=orientation * claim.orientation_noise)
    scale = np.sqrt(scale_after(fly(2, 8.0, sensors).poses))
    np.testing.assert_allclose(scale, [position, orientation], rtol=0.25)


def test_uneven_captures_and_jumps_are_not_noise():
    poses = fly(3, 6.0).poses
    uneven = [pose for k, pose in enumerate(poses) if k % 5]
    assert np.array_equal(scale_after(uneven), [1.0, 1.0])
    for pose in poses[300:]:
        pose.position[:] += 1.0
    assert np.array_equal(scale_after(poses[:500]), [1.0, 1.0])
