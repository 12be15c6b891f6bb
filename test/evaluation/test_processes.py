"""Faults of processes: messages of estimator, controllers and supervisor."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.evaluation.loop import Processes, QUEUE
from beetle_omni_ros.robot.readings import BatteryReading, ImuReading
from beetle_omni_ros.sim.faults import Fault, Schedule
from beetle_omni_ros.sim.sensors import Frame

TICK = 0.005
STATE = State(1.0, np.ones(3), np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(4),
              np.zeros(4), 1.0)


class SupervisorStub:
    """Stand-in for the supervisor that stores messages."""

    def __init__(self):
        self.received = []

    def __getattr__(self, method):
        """Store every message."""
        return lambda *message: self.received.append((method, *message))


@pytest.fixture
def make_faulty():
    """Make processes with faults that begin at 0 s; return them and the stand-in."""
    def make(*faults):
        stub = SupervisorStub()
        processes = Processes(TICK, stub)
        processes.schedule.set(faults, 0.0)
        processes.frame(frame(0.0))
        return processes, stub
    return make


def frame(time):
    return Frame(time, ImuReading(time, np.ones(3), np.ones(3)), None, None,
                 BatteryReading(time, 24.0, -5.0), None)


def command(stamp):
    return Command(stamp, np.full(4, 0.1), np.full(4, 8.0))


def test_a_paused_supervisor_receives_the_newest_messages_of_its_queues(make_faulty):
    processes, stub = make_faulty(Fault('supervisor_waits', duration=0.1))
    for k in range(20):
        processes.inbox.on_battery(k)
    processes.inbox.on_imu(0)
    assert stub.received == []
    processes.frame(frame(0.1))
    assert processes.inbox is stub
    assert [value for method, value in stub.received if method == 'on_battery'] \
        == list(range(20 - QUEUE, 20))
    assert ('on_imu', 0) in stub.received


def test_a_clock_step_shifts_every_stamp_and_is_reversible(make_faulty):
    processes, _ = make_faulty(Fault('clock_jumps', at=0.1, duration=0.2, step=-3.0))
    for time, step in ((0.05, 0), (0.15, -3), (0.35, 0)):
        shifted = processes.frame(frame(time))
        assert processes.clock_step == step
        assert shifted.time == time + step == shifted.imu.stamp == shifted.battery.stamp


def through(fault, signal, *items):
    """Items that pass through a fault which is active from 0 s."""
    schedule = Schedule(TICK, np.random.SeedSequence(0))
    schedule.set([fault], 0.0)
    schedule.update(0.0)
    return [schedule.through(signal, item, now) for item, now in items]


def test_a_silent_controller_sends_nothing_and_a_slow_one_sends_late():
    assert through(Fault('controller_silent'), 'request', (command(1.0), 1.0)) == [[]]
    at_once, early, (late,) = through(Fault('controller_slow', delay=0.08), 'request',
                                      (command(1.0), 1.0), (None, 1.075), (None, 1.08))
    assert at_once == early == [] and late.stamp == 1.0


def test_faults_of_estimates():
    def estimates(kind, *states, **numbers):
        return through(Fault(kind, **numbers), 'estimate', *((state, 0.0) for state in states))

    assert estimates('estimator_dead', STATE) == [[]]
    (spoilt,), = estimates('estimator_nan', STATE)
    assert np.isnan(spoilt.position).all()
    _, (frozen,) = estimates('estimator_frozen', STATE, replace(
        STATE, stamp=2.0, position=np.zeros(3)))
    assert frozen.stamp == 2.0 and frozen.position[0] == 1.0
    *_, (away,) = estimates('estimator_diverges', *200 * [STATE], acceleration=2.0)
    assert np.isclose(away.position[0] - 1.0, 1.0) and np.isclose(away.velocity[0], 2.0)
    (random,), = estimates('estimator_rubbish', STATE)
    assert np.isclose(np.linalg.norm(random.quaternion), 1.0)


def test_a_bridge_reports_a_changed_state_once(make_faulty):
    processes, stub = make_faulty(Fault('motor_board_lost', at=0.0))
    processes.frame(frame(0.1))
    assert stub.received == [('on_actuators', 'rotor', 'lost: motor board silent', 0.0)]
