"""Faults of processes: messages of estimator, controllers and supervisor in the loop."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.flight.component import Component
from beetle_omni_ros.flight.loop import Loop, QUEUE
from beetle_omni_ros.flight.stack import ProcessFaults
from beetle_omni_ros.flight.surroundings import SimulatedRobot
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.sim.faults import Fault
from beetle_omni_ros.sim.simulator import Simulator

TICK = 0.005
ROBOT = RobotParameters.load()
ODOM = BodyState(1.0, np.ones(3), np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3))


def command(stamp):
    return Command(stamp, np.full(4, 0.1), np.full(4, 8.0))


def test_a_component_that_is_not_scheduled_then_gets_the_newest_messages_of_its_queues():
    received, called = [], []
    reader = Component('reader_node')
    reader.reads('nmpc/command', lambda value: received.append(value.stamp))
    reader.every(TICK, lambda: called.append(1))
    loop = Loop(SimulatedRobot(Simulator(ROBOT), ROBOT), [reader])
    loop.suspend(reader)
    for k in range(20):
        loop.publish('nmpc/command', command(k))
        loop.step()
    assert received == called == []
    loop.resume(reader)
    assert received == list(range(20 - QUEUE, 20))
    loop.step()
    assert called == [1]


@pytest.fixture
def make():
    """Make faults of processes that are active from 0 s."""
    def build(*faults):
        made = ProcessFaults(TICK)
        made.set(faults, 0.0)
        made.update(0.0)
        return made
    return build


def passed(faults, topic, *values, now=0.0):
    return [faults.passed(topic, value, 'nmpc', now) for value in values]


def test_a_clock_step_lasts_as_long_as_its_fault(make):
    faults = make(Fault('clock_jumps', at=0.1, duration=0.2, step=-3.0))
    for time, step in ((0.05, 0), (0.15, -3), (0.35, 0)):
        faults.update(time)
        assert faults.clock_step == step


def test_a_silent_controller_sends_nothing_and_a_slow_one_sends_late(make):
    silent = make(Fault('controller_silent'))
    assert passed(silent, 'nmpc/command', command(1.0)) == [[]]
    (standby,), = passed(silent, 'rl/command', command(1.0))
    assert standby.stamp == 1.0         # only the active controller fails
    slow = make(Fault('controller_slow', delay=0.08))
    assert passed(slow, 'nmpc/command', command(1.0), now=1.0) == [[]]
    assert slow.messages('nmpc', 1.075) == []
    (topic, late), = slow.messages('nmpc', 1.08)
    assert topic == 'nmpc/command' and late.stamp == 1.0


def test_faults_of_estimates(make):
    def estimates(kind, *values, **numbers):
        return passed(make(Fault(kind, **numbers)), 'odom', *values)

    assert estimates('estimator_dead', ODOM) == [[]]
    (spoilt,), = estimates('estimator_nan', ODOM)
    assert np.isnan(spoilt.position).all()
    _, (frozen,) = estimates('estimator_frozen', ODOM, replace(
        ODOM, stamp=2.0, position=np.zeros(3)))
    assert frozen.stamp == 2.0 and frozen.position[0] == 1.0
    *_, (away,) = estimates('estimator_diverges', *200 * [ODOM], acceleration=2.0)
    assert np.isclose(away.position[0] - 1.0, 1.0) and np.isclose(away.velocity[0], 2.0)
    (random,), = estimates('estimator_rubbish', ODOM)
    assert np.isclose(np.linalg.norm(random.quaternion), 1.0)


def test_a_bridge_reports_a_changed_state_once_and_a_foreign_target_comes_once(make):
    faults = make(Fault('motor_board_lost'), Fault('target', x=60.0))
    (bridge, text), (topic, target) = faults.messages('nmpc', 7.0)
    assert (bridge, text) == ('rotor_bridge/state', 'lost: motor board silent')
    assert topic == 'target_pose' and target.position[0] == 60.0 and target.stamp == 7.0
    assert faults.messages('nmpc', 7.1) == []
