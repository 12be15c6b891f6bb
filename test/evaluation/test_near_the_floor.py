"""Moves near the floor: a far move with a large turn sinks, but not to the floor."""

import numpy as np

from beetle_omni_ros.faults.flight import Flight
from beetle_omni_ros.robot import rotations

REACH = 0.39    # [m] of a propeller below base_link


def test_a_far_move_from_upside_down_keeps_the_propellers_off_the_floor():
    flight = Flight(controller='nmpc', conditions='nominal', seed=3)
    flight.loop.take_off()
    flight.aim((1.69, 1.63, 0.85), rotations.from_rpy(*np.radians([156.0, -38.0, -85.0])))
    flight.fly(6.0)
    target = np.array([-0.87, -2.0, 0.61])
    flight.aim(target, rotations.from_rpy(*np.radians([-75.0, -43.0, -129.0])))
    lowest = 1.0
    while not flight.fly(0.05, lambda: flight.supervisor.state != 'flying') \
            and np.linalg.norm(flight.simulator.truth.position - target) > 0.02:
        lowest = min(lowest, flight.simulator.truth.position[2])
        assert flight.simulator.time < 30
    assert flight.supervisor.state == 'flying'
    assert lowest > REACH
