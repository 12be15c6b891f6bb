"""Commands to the actuators: checks, delay, timeout."""

from types import SimpleNamespace

import numpy as np
import pytest
from sim_robots import ROBOT, WORLD

from beetle_omni_ros.sim.simulator import CommandLink


def link():
    """A link under nominal conditions: 10 ms delay, 100 ms timeout."""
    return CommandLink(ROBOT, WORLD.command_timeout, (0.01, 0.01))


def command(stamp, tilt=0.1, thrust=5.0):
    return SimpleNamespace(stamp=stamp, tilt=np.full(4, tilt), thrust=np.full(4, thrust))


def test_command_acts_at_stamp_plus_delay():
    made = link()
    assert made.push(command(0.0), 0.0)
    made.update(0.0099)
    assert made.thrust[0] == 0
    made.update(0.010)
    assert made.thrust[0] == 5 and made.tilt[0] == 0.1


def test_late_command_acts_at_once_but_never_overtakes_a_newer_one():
    made = link()
    made.push(command(1.000, thrust=5), 1.020)
    made.update(1.020)
    assert made.thrust[0] == 5
    assert made.push(command(1.015, thrust=7), 1.020)
    assert not made.push(command(1.010, thrust=6), 1.021)
    made.update(1.025)
    assert made.thrust[0] == 7


@pytest.mark.parametrize('field, value', [
    ('tilt', np.array([0, np.nan, 0, 0])), ('stamp', 1e9)], ids=['not finite', 'future'])
def test_unusable_command_is_refused(field, value):
    made, bad = link(), command(0.0)
    setattr(bad, field, value)
    assert not made.push(bad, 0.0)
    assert made.push(command(0.0), 0.0)


def test_targets_are_clipped_to_the_limits():
    made = link()
    made.push(command(0.0, tilt=9.0, thrust=50.0), 0.0)
    made.update(0.01)
    np.testing.assert_array_equal(made.tilt, ROBOT.joints.position_limit)
    np.testing.assert_array_equal(made.thrust, ROBOT.rotors.thrust_max)
    made.push(command(0.005, tilt=-9.0, thrust=-5.0), 0.01)
    made.update(0.02)
    np.testing.assert_array_equal(made.tilt, -ROBOT.joints.position_limit)
    np.testing.assert_array_equal(made.thrust, ROBOT.rotors.thrust_min)


def test_rotors_stop_when_commands_cease_and_tilts_hold():
    made = link()
    made.push(command(0.0), 0.0)
    made.update(0.095)
    assert made.thrust[0] == 5
    made.update(0.100)
    assert made.thrust[0] == 0 and made.tilt[0] == 0.1
    made.push(command(0.2), 0.2)
    made.update(0.21)
    assert made.thrust[0] == 5
