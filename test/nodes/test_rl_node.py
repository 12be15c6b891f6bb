"""rl_node, its policy, and changes of the controller in a flight."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterEvent
from witness import running_graph, Witness

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.policy import DEFAULT, PolicyController, PolicyParameters
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.controller_node import RlNode
from beetle_omni_ros.nodes.plan import controller_nodes, unfit
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.safety.parameters import SupervisorParameters

pytest.importorskip('onnx')

from hover_policy import write_hover_policy
from policy_files import write

SWITCHES = 10
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_the_node_publishes_the_commands_of_the_policy(make, tmp_path):
    policy = write(tmp_path / 'policy.onnx', hidden=(32, 16), seed=5)
    node, sent = make(RlNode, f'policy:={policy}'), []
    node._publisher = SimpleNamespace(publish=sent.append)
    controller = PolicyController(RobotParameters.load(), replace(
        PolicyParameters.load(), policy=str(policy)))
    target = PoseTarget(np.array([0.2, 0.0, 1.5]), LEVEL, 0.9)
    node._on_target(target)
    for k in range(10):
        odom = Odom(1.0 + 0.01 * k, np.array([0.0, 0.1 * k, 1.0]), np.array([0.1, 0.2, -0.3]),
                    np.array([0.5, 0.5, 0.5, 0.5]), np.array([0.3, 0.0, -0.1]))
        joints = JointReading(odom.stamp, np.array([0.1, -0.2, 0.3, 0.0]), np.zeros(4))
        node._on_joints(joints)
        node._on_odom(odom)
        expected = controller.step(State.join(odom, joints, None), target)
        assert np.allclose(sent[k].tilt, expected.tilt)
        assert np.allclose(sent[k].thrust, expected.thrust)
    assert node._controller_status()[2]['policy'] == 'rl'


def test_a_file_of_the_nmpc_reaches_its_node(tmp_path):
    mine = tmp_path / 'mine.yaml'
    mine.write_text('limits: {tilt_rate_share: 0.5}\n')
    for active in ('nmpc', 'hover'):
        assert controller_nodes(active, nmpc=str(mine))[0]['nmpc_node'] == {'nmpc_file': str(mine)}
    with pytest.raises(ParameterError, match="for the controller 'nmpc', which does not run"):
        controller_nodes('hover', nmpc=str(mine), standby=False)
    mine.write_text('limits: {tilt_rate: 7.0}\n')
    with pytest.raises(ParameterError, match="unknown key; did you mean 'tilt_rate_share'"):
        controller_nodes('nmpc', nmpc=str(mine))


def test_an_unusable_policy_is_not_on_standby(tmp_path):
    policy = str(write(tmp_path / 'policy.onnx'))
    other = str(share_path('params/robot_weak_and_heavy.yaml'))
    assert list(controller_nodes('nmpc', policy=policy)[0]) == ['nmpc_node', 'rl_node']
    nodes, reason = controller_nodes('nmpc', policy=policy, robot_file=other)
    assert list(nodes) == ['nmpc_node'] and 'mass' in reason['rl']
    nodes, reason = controller_nodes('nmpc', policy=policy, robot_file=other,
                                     allow_other_robot=True)
    assert nodes['rl_node'] == {'robot_file': other, 'policy': policy, 'allow_other_robot': True}
    with pytest.raises(ParameterError, match='no such file'):
        controller_nodes('rl', policy=str(tmp_path / 'none.onnx'))


class Pilot(Witness):
    """Witness that selects controllers like `ros2 param set`, and stores every command."""

    def __init__(self, domain):
        super().__init__(domain)
        self.taken, self.switches, self.targets = [], [], []
        self._node.create_subscription(ParameterEvent, '/parameter_events', self._on_change, 100)
        wire.subscribe(self._node, 'target_pose', lambda target: self.targets.append(target.stamp))

    def _on_change(self, event):
        if 'controller' in [parameter.name for parameter in event.changed_parameters]:
            self.switches.append(conversions.seconds(event.stamp))

    def _on_actuators(self, message):
        super()._on_actuators(message)
        self.taken.append(self.last_command[1])

    def select_when_good(self, name):
        """Select a controller, repeated while a busy computer delays the controller."""
        for _ in range(20):
            accepted, reason = self.set('supervisor_node', 'controller', name)
            if accepted or 'good for only' not in reason:
                break
            self.spin(0.3)
        return accepted, reason


@pytest.fixture
def flight(ros_domain, tmp_path):
    """
    The composed graph in flight through random poses with both controllers.

    The policy is the shipped one, or a hand-written one if that is incompatible. test_switching.py
    flies both in one process.
    """
    policy = ''
    if unfit(DEFAULT):
        policy = str(write_hover_policy(tmp_path / 'hover.onnx', memory=True))
    controllers, reason = controller_nodes('nmpc', policy=policy)
    assert not reason
    nodes = {'sim_node': {}, 'ekf_node': {}, **controllers, 'supervisor_node': {},
             'reference_node': {'task': 'random20'}}
    with running_graph(nodes, tmp_path, ros_domain, operator=Pilot, simulated=True) \
            as (graph, pilot):
        pilot.take_off(lambda: pilot.progress.startswith('flying'))
        yield graph, pilot


def test_ten_switches_through_the_parameter_in_a_real_flight(flight):
    graph, pilot = flight
    names = ['rl', 'nmpc'] * (SWITCHES // 2)
    for name, wait in zip(names, np.random.default_rng(0).uniform(0.2, 1.4, SWITCHES)):
        assert pilot.stays_in_the_air(wait) or pilot.height_min > 0.15
        assert pilot.select_when_good(name) == (True, '')
        assert pilot.wait(lambda name=name: pilot.state == f'flying:{name}', 2), pilot.states
    pilot.spin(0.5)
    first = pilot.states.index('flying:nmpc')
    assert pilot.states[first:] == ['flying:nmpc', *(f'flying:{name}' for name in names)]
    assert not pilot.set('supervisor_node', 'controller', 'pid')[0]
    assert pilot.state == 'flying:nmpc' and not graph.dead()
    # By stamps: on a busy computer the topics arrive out of step. A command has the stamp of its
    # state, some milliseconds before the switch.
    assert len(pilot.switches) == SWITCHES
    stamps = [command.stamp for command in pilot.taken]
    for mark in np.searchsorted(stamps, pilot.switches):
        assert is_smooth(pilot.taken[mark - 2:mark + 2], pilot.targets)


def is_smooth(commands, targets):
    """Whether commands keep the rates of a hand-over, except after a new target."""
    assert len(commands) == 4
    if any(commands[0].stamp - 0.05 < target < commands[-1].stamp for target in targets):
        return True
    limits = SupervisorParameters.load().handover
    steps = np.diff([command.stamp for command in commands])[:, None] + 1e-6
    tilt = np.abs(np.diff([command.tilt for command in commands], axis=0))
    thrust = np.abs(np.diff([command.thrust for command in commands], axis=0))
    return np.all(tilt <= limits.tilt_rate * steps) and np.all(thrust
                                                               <= limits.thrust_rate * steps)
