"""Nodes of registered controllers: by name, by class, in a whole graph."""

import math
import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from witness import HEADER, READY

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.messages.topics import split_topic, topic_of, topics_with
from beetle_omni_ros.messages.values import MessageError, Odom
from beetle_omni_ros.nodes import health, plan
from beetle_omni_ros.nodes.controller_node import ControllerNode
from beetle_omni_ros.nodes.supervisor_node import SupervisorNode
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import read_bag

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
OWN = f"{Path(__file__).resolve().parents[2] / 'examples' / 'own_controller.py'}:PoseController"


@pytest.fixture
def make(ros_domain):
    """Make one node in this process, with parameters."""
    nodes = []

    def build(node_class, *overrides):
        arguments = [a for override in overrides for a in ('-p', override)]
        rclpy.init(args=['--ros-args', *arguments], domain_id=ros_domain)
        nodes.append(node_class())
        return nodes[0]

    yield build
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def topics(node):
    """Topics that a node publishes."""
    return [publisher.topic_name for publisher in node.publishers]


def test_a_parameter_selects_the_controller_of_a_node(make):
    node = make(ControllerNode, f'controller:={OWN}')
    assert node.get_name() == 'pose_controller_node'
    assert '/pose_controller/command' in topics(node)
    assert node.get_parameter('controller').value == OWN
    assert node._controller_status()[2] == {'guidance': 'none'}


def test_a_shipped_controller_has_its_parameters_and_policy(make):
    node = make(ControllerNode, 'controller:=rl_memory', 'unwinding.attempts:=0')
    assert node.get_name() == 'rl_memory_node'
    assert node.get_parameter('policy').value == registry.find('rl_memory').policy_file
    assert node.get_parameter('unwinding.attempts').value == 0
    assert node._controller_status()[2]['guidance'] == 'routing, turning, trimming'


def test_any_controller_sees_true_tilts_and_no_target_beyond_its_reach(make, monkeypatch):
    node, seen = make(ControllerNode, f'controller:={OWN}'), []
    controller = node._host.controller
    step = controller.step
    monkeypatch.setattr(controller, 'step', lambda state, target: seen.append(state) or step(
        state, target))
    health = ActuatorHealth(zeros=(0.1, 0.0, 0.0, -0.2))
    node._on_actuators(SimpleNamespace(health=health))
    node._on_joints(JointReading(1.0, np.zeros(4), np.zeros(4)))
    node._on_odom(Odom(1.0, np.array([0.0, 0.0, 1.0]), np.zeros(3), LEVEL,
                               np.zeros(3)))
    assert seen[0].tilt == pytest.approx(health.true(np.zeros(4))) and seen[0].tilt.any()
    far = PoseTarget(np.array([9.0, 0.0, 1.0]), LEVEL, 1.0)
    node._on_mode('flying:pose_controller')
    node._check_target(far, math.nan)       # its reach is not limited
    controller.reach = 3.0
    with pytest.raises(MessageError, match='expected at most 3 m'):
        node._check_target(far, math.nan)


FAILING = """from beetle_omni_ros.control.hover import HoverController


class Failing(HoverController):
    fails_from = {fails_from}

    def step(self, state, target):
        if state.stamp > self.fails_from:
            state.positon
        return super().step(state, target)
"""


def test_an_exception_of_step_is_logged_and_reported_and_publishes_no_command(
        make, tmp_path, capfd):
    own, published = tmp_path / 'bad.py', []
    own.write_text(FAILING.format(fails_from=1.5))
    node = make(ControllerNode, f'controller:={own}:Failing')
    node._publisher = SimpleNamespace(publish=published.append)
    node._on_joints(JointReading(1.0, np.zeros(4), np.zeros(4)))

    def step(stamp):
        node._on_odom(Odom(stamp, np.array([0.0, 0.0, 1.0]), np.zeros(3), LEVEL, np.zeros(3)))

    step(1.0)
    step(2.0)
    step(2.1)
    assert [command.stamp for command in published] == [1.0]
    error = "controller 'failing': step raised AttributeError: 'State' object has no attribute " \
            "'positon' (bad.py:9)"
    level, text, values = node._controller_status()
    assert (level, text, values['errors']) == (health.ERROR, error, 2)
    assert node._controller_status()[0] == health.OK      # none since the last report
    node._host.controller.step = lambda state, target: ()
    step(2.2)
    assert 'step returned tuple' in node._controller_status()[1] and len(published) == 1
    lines = [line for line in capfd.readouterr().err.splitlines() if 'ERROR' in line]
    assert len(lines) == 1 and lines[0].endswith(error)     # at most one a second


@pytest.mark.simulated_time
def test_fly_names_the_exception_of_a_controller_and_the_supervisor_lands(tmp_path):
    own, task = tmp_path / 'bad.py', tmp_path / 'poses.csv'
    own.write_text(FAILING.format(fails_from='float("inf")').replace(
        'state.stamp > self', 'state.position[2] > 1.3 or state.stamp > self'))
    task.write_text(HEADER + '0,0,1.6,0,0,0\n')      # higher than the climb
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'fly', '--controller',
         f'{own}:Failing', '--task', str(task), '--bag', str(tmp_path / 'bag'), '--alone',
         '--clock', 'simulated'], capture_output=True, text=True, timeout=READY, check=False,
        env=dict(os.environ))
    line = done.stderr.splitlines()[0]
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert line.startswith("beetle_omni fly: error: controller 'failing': step raised Attribute")
    assert line.endswith('(bad.py:9)') and line not in done.stdout
    states = [state.partition(':')[0] for state in read_bag(tmp_path / 'bag').states]
    assert 'fallback' in states and states[-2:] == ['landing', 'disarmed']


def test_the_supervisor_accepts_the_listed_controllers(make):
    node = make(SupervisorNode, f"controllers:=['nmpc','{OWN}']", 'controller:=pose_controller')
    assert node._supervisor.active == 'pose_controller'
    assert node.get_parameter('controllers').value == ['nmpc', OWN]
    refused, = node.set_parameters([rclpy.parameter.Parameter('controller', value='rl')])
    assert not refused.successful and 'nmpc, pose_controller' in refused.reason


def test_an_active_controller_outside_the_supervisors_list_is_refused(make):
    with pytest.raises(ParameterError, match="'controller': expected one of nmpc, rl, found 'x'"):
        make(SupervisorNode, 'controller:=x')


@pytest.mark.parametrize('override, message', [
    ((), "'controller': missing"), (('-p', 'controller:=nmpx'), "'nmpx': expected one of nmpc"),
    (('-p', 'controller:=absent.module:My'), "no module 'absent'"),
    (('-p', f'controller:={OWN}Not'), 'its classes: PoseController')])
def test_an_unusable_controller_ends_the_node_with_one_line(ros_domain, override, message):
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'controller_node', '--ros-args',
         *override],
        capture_output=True, text=True, timeout=60, check=False, env=dict(os.environ))
    assert done.returncode == 2, done.stderr
    line, = done.stderr.strip().splitlines()
    assert line.startswith('controller_node: error: ') and message in line


def test_the_plan_of_a_graph_with_another_controller():
    nodes = plan.plan(plan.GraphOptions(controller=OWN, actuators='direct', bag='/b',
                                        task='hover')).nodes
    assert list(nodes) == ['recorder_node', 'sim_node', 'ekf_node', 'pose_controller_node',
                           'nmpc_node', 'rl_node', 'supervisor_node', 'reference_node']
    assert nodes['pose_controller_node'] == {'controller': OWN}
    assert nodes['supervisor_node']['controller'] == 'pose_controller'
    known = ['pose_controller', *registry.standing_by()]
    assert nodes['supervisor_node']['controllers'] == known
    assert nodes['recorder_node']['controllers'] == known
    assert plan.executable('pose_controller_node') == 'controller_node'
    assert plan.arguments(nodes, ['ekf_node', 'pose_controller_node']) == ['ekf_node', OWN]
    alone = plan.plan(plan.GraphOptions(controller=OWN, actuators='direct', standby=False)).nodes
    assert list(alone) == ['sim_node', 'ekf_node', 'pose_controller_node', 'supervisor_node']


def test_topics_of_any_controller_are_distinguished_from_those_of_a_robot():
    assert split_topic('/nmpc/command') == ('', 'nmpc/command')
    assert split_topic('/robot1/rl/command') == ('/robot1', 'rl/command')
    assert split_topic('/robot1/command') == ('/robot1', 'command')
    assert split_topic('/own/command', ('',)) == ('', 'own/command')
    assert split_topic('/robot1/own/command', ('/robot1',)) == ('/robot1', 'own/command')
    assert split_topic('/robot1/command', ('/robot1',)) == ('/robot1', 'command')
    assert topic_of('own/command') == topic_of('nmpc/command') == topics_with(['x'])['x/command']
