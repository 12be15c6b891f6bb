"""Targets of the controller protocol."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import TrajectoryTarget


@pytest.mark.parametrize('seed', range(3))
def test_a_trajectory_at_one_time_is_a_sample_of_length_one(seed):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0, 10, 200))
    turns = Rotation.from_euler('xyz', np.cumsum(0.2 * rng.normal(size=(200, 3)), axis=0))
    path = TrajectoryTarget(times, rng.normal(size=(200, 3)),
                            turns.as_quat() * rng.choice([-1, 1], 200)[:, None],
                            rng.normal(size=(200, 3)), rng.normal(size=(200, 3)))
    for moment in (-1.0, *times[[0, 1, 100, -2, -1]], 11.0, *rng.uniform(0, 10, 50)):
        one, many = path.at(moment), path.sample(np.array([moment]))
        for name in ('position', 'quaternion', 'velocity', 'angular_velocity'):
            assert np.allclose(getattr(one, name), getattr(many, name)[0], atol=1e-12), name
