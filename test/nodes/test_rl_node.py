"""rl_node as a process, and changes of the controller in a flight."""

from dataclasses import replace
import os
import subprocess
import sys
import time

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from witness import READY, Witness

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.policy import DEFAULT, PolicyController, PolicyParameters
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.topics import COMMAND, ESTIMATE, LATCHED, SENSOR
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.plan import controller_nodes, unfit
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.safety.parameters import SupervisorParameters

pytest.importorskip('onnx')

from hover_policy import write_hover_policy
from policy_files import write

SWITCHES = 20
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture
def process(ros_domain, tmp_path):
    """rl_node in its own process with an artificial policy; (graph, witness, file)."""
    policy = write(tmp_path / 'policy.onnx', hidden=(32, 16), seed=5)
    graph = Graph({'rl_node': {'policy': str(policy)}}, tmp_path, ros_domain, composed=False)
    witness = None
    try:
        graph.start()
        witness = Witness(ros_domain)
        yield graph, witness, policy
    finally:
        graph.stop()
        if witness:
            witness.close()


def test_the_node_publishes_the_commands_of_the_controller(process):
    graph, witness, policy = process
    node = witness._node
    odom = node.create_publisher(Odometry, 'odom', wire.profile(ESTIMATE))
    joints = node.create_publisher(JointState, 'joint_states', wire.profile(SENSOR))
    targets = node.create_publisher(PoseStamped, 'target_pose', wire.profile(LATCHED))
    answers = []
    node.create_subscription(JointState, 'rl/command', lambda m: answers.append(
        conversions.take_command(m)), wire.profile(COMMAND))
    assert witness.wait(lambda: odom.get_subscription_count() and joints.get_subscription_count()
                        and targets.get_subscription_count() > 1, 30), graph.dead()
    tilt = np.array([0.1, -0.2, 0.3, 0.0])
    controller = PolicyController(RobotParameters.load(), replace(
        PolicyParameters.load(), policy=str(policy)))
    target = PoseTarget(np.array([0.2, 0.0, 1.5]), LEVEL)
    targets.publish(wire.message('target_pose', replace(target, stamp=time.time())))
    witness.spin(0.3)

    def ask(k):
        now = time.time()
        state = Odom(now, np.array([0.0, 0.1 * k, 1.0]), np.array([0.1, 0.2, -0.3]),
                     np.array([0.5, 0.5, 0.5, 0.5]), np.array([0.3, 0.0, -0.1]))
        joints.publish(wire.message('joint_states', JointReading(now - 0.01, tilt, np.zeros(4))))
        witness.spin(0.01)
        odom.publish(wire.message('odom', state))
        witness.spin(0.02)
        expected = controller.step(
            State.join(state, JointReading(now, tilt, np.zeros(4)), None), target)
        return round(now, 4), np.concatenate((expected.tilt, expected.thrust))

    def answered(requested):
        found = {round(a.stamp, 4): np.concatenate((a.tilt, a.thrust)) for a in answers}
        return [(found[stamp], answer) for stamp, answer in requested.items() if stamp in found]

    # On a busy machine the target arrives late; the answers are compared after its arrival.
    assert witness.wait(
        lambda: any(np.allclose(*pair, atol=1e-5) for pair in answered(dict([ask(0)]))), 30)
    pairs = answered(dict(ask(k) for k in range(20)))
    assert len(pairs) >= 10, graph.dead()
    for answer, expected in pairs:
        assert np.allclose(answer, expected, atol=1e-5)
    assert witness.wait(lambda: witness.values('rl_node: controller').get('steps'), 5)
    assert witness.values('rl_node: controller')['policy'] == 'rl'
    assert not graph.dead()


def refusal(*overrides):
    """Error of rl_node, which does not start: status 2 and one line."""
    arguments = [a for override in overrides for a in ('-p', override)]
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'rl_node', '--ros-args', *arguments],
        capture_output=True, text=True, timeout=60, check=False, env=dict(os.environ))
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith('rl_node: error: '), lines
    return lines[0]


def test_a_policy_that_cannot_fly_is_refused_at_the_start(ros_domain, tmp_path):
    assert 'no such file' in refusal(f"policy:={tmp_path / 'none.onnx'}")
    cut = tmp_path / 'cut.onnx'
    cut.write_bytes(write(tmp_path / 'whole.onnx').read_bytes()[:300])
    assert 'not a readable ONNX file' in refusal(f'policy:={cut}')
    other = share_path('params/robot_weak_and_heavy.yaml')
    assert 'mass' in refusal(f"policy:={tmp_path / 'whole.onnx'}", f'robot_file:={other}')


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
    assert list(controller_nodes('rl', policy=policy)[0]) == ['rl_node', 'nmpc_node']
    nodes, reason = controller_nodes('nmpc', policy=policy, robot_file=other)
    assert list(nodes) == ['nmpc_node'] and 'mass' in reason['rl']
    nodes, reason = controller_nodes('nmpc', policy=policy, robot_file=other,
                                     allow_other_robot=True)
    assert nodes['rl_node'] == {'robot_file': other, 'policy': policy, 'allow_other_robot': True}
    assert unfit(policy, other) and not unfit(policy, other, True)
    with pytest.raises(ParameterError, match='no such file'):
        controller_nodes('rl', policy=str(tmp_path / 'none.onnx'))
    with pytest.raises(ParameterError, match="'hoover': expected one of nmpc, rl"):
        controller_nodes('hoover')


class Pilot(Witness):
    """Witness that selects controllers like `ros2 param set`, and stores every command."""

    def __init__(self, domain):
        super().__init__(domain)
        self.client = AsyncParameterClient(self._node, 'supervisor_node')
        self.taken, self.switches, self.targets = [], [], []
        self._node.create_subscription(ParameterEvent, '/parameter_events', self._on_change, 100)
        wire.subscribe(self._node, 'target_pose', lambda target: self.targets.append(target.stamp))

    def _on_change(self, event):
        if 'controller' in [parameter.name for parameter in event.changed_parameters]:
            self.switches.append(conversions.seconds(event.stamp))

    def _on_actuators(self, message):
        super()._on_actuators(message)
        self.taken.append(self.last_command[1])

    def select(self, name):
        """Set the parameter; return (accepted, reason)."""
        future = self.client.set_parameters([Parameter('controller', value=name)])
        assert self.wait(future.done, 3), 'supervisor_node does not answer'
        result = future.result().results[0]
        return result.successful, result.reason

    def select_when_good(self, name):
        """Like :meth:`select`, repeated while a busy computer delays the controller."""
        for _ in range(20):
            accepted, reason = self.select(name)
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
    graph = Graph({'sim_node': {}, 'ekf_node': {}, **controllers, 'supervisor_node': {},
                   'reference_node': {'task': 'random20'}}, tmp_path, ros_domain, simulated=True)
    pilot = None
    try:
        graph.start()
        pilot = Pilot(ros_domain)
        assert pilot.wait(lambda: pilot.ready and pilot.client.services_are_ready(), READY), \
            graph.dead()
        pilot.take_off(lambda: pilot.progress.startswith('flying'))
        yield graph, pilot
    finally:
        stubborn = graph.stop()
        if pilot:
            pilot.close()
    assert not stubborn


@pytest.mark.simulated_time
def test_twenty_switches_through_the_parameter_in_a_real_flight(flight):
    graph, pilot = flight
    names = ['rl', 'nmpc'] * (SWITCHES // 2)
    for name, wait in zip(names, np.random.default_rng(0).uniform(0.2, 1.4, SWITCHES)):
        assert pilot.stays_in_the_air(wait) or pilot.height_min > 0.15
        assert pilot.select_when_good(name) == (True, '')
        assert pilot.wait(lambda name=name: pilot.state == f'flying:{name}', 2), pilot.states
    pilot.spin(0.5)
    first = pilot.states.index('flying:nmpc')
    assert pilot.states[first:] == ['flying:nmpc', *(f'flying:{name}' for name in names)]
    assert not pilot.select('pid')[0]
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
