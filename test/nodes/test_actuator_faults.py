"""
Faults of servos and motor board in flight: reaction of the robot, report, final actuator state.

The whole graph flies through both bridges. Parameters of sim_node switch faults of the emulated
devices on. The true state of rotors and servos is read from the simulator. A robot that still
flies without fault at the end of a test is used by the next one.
"""

from contextlib import contextmanager, ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
from std_srvs.srv import Trigger
from witness import PATIENT, running_graph, Witness

from beetle_omni_ros.nodes import discovery
from beetle_omni_ros.nodes.graph import BRIDGES_COMPOSED
from beetle_omni_ros.nodes.plan import bridge_parameters, BRIDGES

pytestmark = pytest.mark.alone

FLYING = 'flying:nmpc'
DEVICES = 'sim_node: devices'


class FaultOperator(Witness):
    """Witness that sets faults of the simulated devices; ``sound`` if there are none."""

    sound = False

    def set(self, name, value):
        """Set a parameter of sim_node."""
        accepted, reason = super().set('sim_node', name, value)
        assert accepted, reason

    def device(self, key):
        """Newest value of the devices' diagnostics, as number or text."""
        self.diagnostics.pop(DEVICES, None)
        assert self.wait(lambda: DEVICES in self.diagnostics, 5), 'sim_node is silent'
        return self.values(DEVICES)[key]

    def start(self):
        """Arm as soon as the bridges are ready, and wait until the controller flies."""
        assert self.wait(lambda: not self.waits_for(BRIDGES), 20), self.waits_for(BRIDGES)
        self.take_off(lambda: self.state == FLYING)

    def count(self, node, status, key):
        """A counter of a bridge's diagnostics; 0 if missing."""
        return int(self.values(f'{node}: {status}').get(key, 0))

    def ask(self, service):
        """Call a service of joint_bridge_node."""
        client = self._node.create_client(Trigger, f'joint_bridge_node/{service}')
        assert self.wait(client.service_is_ready, 5)
        future = client.call_async(Trigger.Request())
        assert self.wait(future.done, 5)
        return future.result().success


@contextmanager
def flying_graph(folder):
    """Graph and operator of a flying robot, in a separate ROS domain."""
    parameters = {'sim_node': {}, 'ekf_node': {}, 'nmpc_node': {}, 'supervisor_node': PATIENT}
    for node, values in bridge_parameters(folder, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    with discovery.reserved_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(number))
        with running_graph(parameters, folder, number, operator=FaultOperator) as robot:
            robot[1].can_judge(robot[0])
            robot[1].start()
            yield robot


@pytest.fixture(scope='module')
def shared_flight():
    """Keeps a flying robot from one test to the next."""
    with ExitStack() as stack:
        yield SimpleNamespace(stack=stack, robot=None)


@pytest.fixture
def robot(shared_flight, tmp_path):
    """Graph and operator of a flying robot, if possible those of the last test."""
    if shared_flight.robot is None:
        shared_flight.robot = shared_flight.stack.enter_context(flying_graph(tmp_path))
    graph, operator = shared_flight.robot
    operator.sound = False
    yield graph, operator
    if not operator.sound or operator.state != FLYING:
        shared_flight.robot = None
        shared_flight.stack.close()


# parameters of sim_node, set and reset; bridge, status and counters of the faults
BEARABLE = [
    ({'servo_faults.bad_crc': 0.03, 'servo_faults.dropped': 0.03, 'servo_faults.delayed': 0.01,
      'servo_faults.supply_voltage': 14.5, 'servo_faults.expire_watchdog': 3},
     {'servo_faults.bad_crc': 0.0, 'servo_faults.dropped': 0.0, 'servo_faults.delayed': 0.0,
      'servo_faults.supply_voltage': 12.0}, 'joint', 'bus', ('corrupt', 'unanswered')),
    ({'board_faults.corrupt_out': 0.05, 'board_faults.corrupt_in': 0.05,
      'board_faults.drop_out': 0.05, 'board_faults.drop_in': 0.05,
      'board_faults.voltage_sag': 1.5},
     {f'board_faults.{name}': 0.0 for name in (
         'corrupt_out', 'corrupt_in', 'drop_out', 'drop_in', 'voltage_sag')}, 'rotor', 'board',
     ('bad_crc', 'board bad_crc', 'lost', 'board lost')),
    ({'board_faults.delay_in': 0.01, 'board_faults.delay_out': 0.01},
     {'board_faults.delay_in': 0.0, 'board_faults.delay_out': 0.0}, 'rotor', 'board',
     ('cycles',))]


def test_faults_with_recovery_in_the_drivers_do_not_end_a_flight(robot):
    graph, operator = robot
    for switched, mended, bridge, status, counters in BEARABLE:
        def counts(node=f'{bridge}_bridge_node', status=status, counters=counters):
            return np.array([operator.count(node, status, counter) for counter in counters])

        before = counts()
        for name, value in switched.items():
            operator.set(name, value)
        assert operator.stays_in_the_air(1.0), switched
        assert operator.wait(lambda n=before, now=counts: np.all(now() > n), 10), switched
        for name, value in mended.items():
            operator.set(name, value)
        assert operator.state == FLYING, (switched, operator.states)
    assert operator.wait(lambda: np.linalg.norm(operator.truth.velocity) < 0.1, 10)
    assert not graph.dead()
    operator.sound = True


# fault, value without fault; state of the bridge; whether it needs a reboot
LANDING = [
    ('servo_faults.silent', [2], [], 'lost: gimbal2', False),
    ('servo_faults.overheated', [3], [], 'lost: gimbal3', True),
    ('board_faults.mute', True, False, 'silent: no message', False),
]


def test_a_failed_or_silent_actuator_ends_the_flight_with_a_landing(robot):
    graph, operator = robot
    for name, value, mended, text, reboot in LANDING:
        states = []
        operator.set(name, value)
        assert operator.wait(lambda s=states: s.extend(operator.bridges.values())
                             or operator.state == 'landing', 5), (name, operator.states)
        assert any(line.startswith(text) for line in states), (name, set(states))
        sinking = []
        assert operator.wait(lambda s=sinking: s.append(operator.truth.velocity[2])
                             or operator.state in ('disarmed', 'emergency_stop'), 30), name
        assert operator.state == 'disarmed' and min(sinking) > -1.0, (name, min(sinking))
        assert operator.wait(lambda: operator.device('armed') == 'False', 5), name
        operator.set(name, mended)
        if reboot:
            assert operator.ask('reboot')
        operator.start()
    assert not graph.dead()
    operator.sound = True


def rests(operator):
    """Whether no rotor is commanded to turn, and none may."""
    return operator.device('armed') == 'False' and not np.any(operator.last_command[1].thrust)


@pytest.mark.parametrize('fault', ['hang', 'unplugged'])
def test_a_board_that_stopped_is_not_armed_again_in_the_fall_or_after_it(robot, fault):
    graph, operator = robot
    before = len(graph.log('composed').read_text())
    operator.set(f'board_faults.{fault}', True)
    assert operator.wait(lambda: operator.state == 'emergency_stop', 5), operator.states
    if fault == 'unplugged':
        operator.set('board_faults.unplugged', False)
    assert 'rotor_bridge_node lost' in graph.log('composed').read_text()[before:]
    assert operator.wait(lambda: rests(operator), 10)
    operator.spin(1.5)
    assert rests(operator)
    assert not graph.dead()


def test_rotors_and_torque_are_off_after_the_bridges_are_killed(robot):
    graph, operator = robot
    graph.kill(BRIDGES_COMPOSED)
    assert operator.wait(lambda: operator.device('armed') == 'False', 10)
    assert operator.wait(lambda: 'True' not in operator.device('torque'), 10)
    assert operator.wait(lambda: operator.state in ('landing', 'disarmed', 'emergency_stop'), 5)
