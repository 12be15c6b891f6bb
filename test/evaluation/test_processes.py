"""Faults of processes: messages of estimator, controllers and supervisor."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.evaluation.loop import Processes, QUEUE
from beetle_omni_ros.robot.readings import BatteryReading, ImuReading
from beetle_omni_ros.sim.faults import Fault
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
        processes.set_faults(faults, 0.0)
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
    assert processes.supervisor_waits
    for k in range(20):
        processes.send('on_battery', k)
    processes.send('on_imu', 0)
    assert stub.received == []
    processes.frame(frame(0.1))
    assert not processes.supervisor_waits
    assert [value for method, value in stub.received if method == 'on_battery'] \
        == list(range(20 - QUEUE, 20))
    assert ('on_imu', 0) in stub.received


def test_a_clock_step_shifts_every_stamp_and_is_reversible(make_faulty):
    processes, _ = make_faulty(Fault('clock_jumps', at=0.1, duration=0.2, step=-3.0))
    for time, step in ((0.05, 0), (0.15, -3), (0.35, 0)):
        shifted = processes.frame(frame(time))
        assert processes.clock_step == step
        assert shifted.time == time + step == shifted.imu.stamp == shifted.battery.stamp


def test_a_silent_controller_sends_nothing_and_a_slow_one_sends_late(make_faulty):
    silent, _ = make_faulty(Fault('controller_silent'))
    assert silent.requests(command(1.0), 1.0) == []
    slow, _ = make_faulty(Fault('controller_slow', delay=0.08))
    assert slow.requests(command(1.0), 1.0) == []
    assert slow.requests(None, 1.075) == []
    late, = slow.requests(None, 1.08)
    assert late.stamp == 1.0


def test_faults_of_estimates(make_faulty):
    assert make_faulty(Fault('estimator_dead'))[0].estimate(STATE) is None
    assert np.isnan(make_faulty(Fault('estimator_nan'))[0].estimate(STATE).position).all()
    frozen, _ = make_faulty(Fault('estimator_frozen'))
    frozen.estimate(STATE)
    later = State(**{**vars(STATE), 'stamp': 2.0, 'position': np.zeros(3)})
    estimate = frozen.estimate(later)
    assert estimate.stamp == 2.0 and estimate.position[0] == 1.0
    away, _ = make_faulty(Fault('estimator_diverges', acceleration=2.0))
    for _ in range(200):
        estimate = away.estimate(STATE)
    assert np.isclose(estimate.position[0] - 1.0, 1.0) and np.isclose(estimate.velocity[0], 2.0)
    random, _ = make_faulty(Fault('estimator_rubbish'))
    assert np.isclose(np.linalg.norm(random.estimate(STATE).quaternion), 1.0)


def test_foreign_targets_and_faults_of_bridge_states(make_faulty):
    processes, _ = make_faulty(Fault('target', z=-5.0, roll=np.pi),
                               Fault('motor_board_lost', at=0.0))
    target = processes.target(PoseTarget(np.zeros(3), STATE.quaternion, 4.0))
    assert target.position[2] == -5.0 and target.stamp == 4.0
    assert processes.bridges == {'rotor': 'lost: motor board silent'}
    assert processes.bridges == {}
