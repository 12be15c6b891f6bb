"""Nodes of registered controllers: by name, by class, when they step, what they log."""

from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter
from witness import Sent

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import graph
from beetle_omni_ros.nodes import node as base
from beetle_omni_ros.nodes.control_nodes import ControllerNode, SupervisorNode
from beetle_omni_ros.nodes.runner import maker
from beetle_omni_ros.robot.allocation import ActuatorHealth
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.schema import ParameterError

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
OWN = f"{Path(__file__).resolve().parents[2] / 'examples' / 'own_controller.py'}:PoseController"
FAILING = """from beetle_omni_ros.control.hover import HoverController


class Failing(HoverController):
    def step(self, state, target):
        if state.stamp > 1.5:
            state.positon
        return super().step(state, target)
"""


class Follower:
    """A controller that records its inputs."""

    name, period = 'follower', 0.01

    def __init__(self):
        self.received, self.resets = [], 0

    def reset(self):
        self.resets += 1

    def step(self, state, target):
        self.received.append((state, target))
        return Command(state.stamp, np.zeros(4), np.full(4, 7.5))


def fly(node, stamps):
    for stamp in np.atleast_1d(stamps):
        node._on_odom(Odom(stamp, np.array([0, 0, 1.0]), np.zeros(3), LEVEL, np.zeros(3)))


@pytest.fixture
def follower(make):
    node = make(partial(ControllerNode, ControllerEntry(name='nmpc', controller=Follower)))
    node._publisher = Sent('nmpc/command')
    fly(node, 99.9 + 0.005 * np.arange(20))
    assert not node._publisher          # no joint angles yet
    node._on_joints(JointReading(100.0, np.zeros(4), np.zeros(4)))
    return node


def test_the_controller_steps_once_a_period_and_stamps_with_the_state(follower):
    health = ActuatorHealth(zeros=(0.1, 0.0, 0.0, -0.2))
    follower._host.on_health(health)
    stamps = 101 + 0.005 * np.arange(200)
    fly(follower, stamps)
    assert np.allclose(follower._publisher.stamps(), stamps[::2])
    state, _ = follower._host.controller.received[-1]
    assert state.tilt == pytest.approx(health.true(np.zeros(4)))
    fly(follower, [95.0, 95.005, 95.01])    # the clock was set back, and the new time is used
    assert len(follower._publisher) == 102


def test_the_newest_target_is_used_an_unset_stamp_means_now_and_a_landing_resets(follower):
    stamps = count(100)

    def target():
        fly(follower, next(stamps))
        return follower._host.controller.received[-1][1]

    for stamp, x in ((50.0, 1.0), (60.0, 2.0), (50.0, 3.0)):
        follower._on_target(PoseTarget(np.array([x, 0, 1.0]), LEVEL, stamp), np.nan)
    assert target().position[0] == 2.0
    follower._on_target(PoseTarget(np.array([4.0, 0, 1.0]), LEVEL, 0.0), np.nan)
    assert target().position[0] == 4.0
    assert target().stamp == pytest.approx(follower.now(), abs=5)
    for mode in ('flying:nmpc', 'disarmed'):
        follower._on_mode(mode)
    assert follower._host.controller.resets == 1


def test_an_exception_of_step_is_logged_and_reported_and_publishes_no_command(
        make, tmp_path, capfd):
    own = tmp_path / 'bad.py'
    own.write_text(FAILING)
    node = make(maker(f'{own}:Failing'))
    node._publisher = Sent('nmpc/command')
    node._on_joints(JointReading(1.0, np.zeros(4), np.zeros(4)))
    fly(node, [1.0, 2.0, 2.1])
    error = "controller 'failing': step raised AttributeError: 'State' object has no attribute " \
            "'positon' (bad.py:7)"
    level, text, values = node._controller_status()
    assert (level, text, values['errors']) == (base.ERROR, error, 2)
    assert node._controller_status()[0] == base.OK      # none since the last report
    assert node._publisher.stamps().tolist() == [1.0]
    lines = [line for line in capfd.readouterr().err.splitlines() if 'ERROR' in line]
    assert len(lines) == 1 and lines[0].endswith(error)     # at most one a second


def test_the_supervisor_selects_among_the_listed_controllers(make):
    node = make(SupervisorNode, f"controllers:=['nmpc','{OWN}']", 'controller:=pose_controller')

    def put(name, value):
        return node.set_parameters([Parameter(name, value=value)])[0]

    assert node._supervisor.active == 'pose_controller'
    assert put('controller', 'nmpc').successful and node._supervisor.active == 'nmpc'
    refused = put('controller', 'rl')
    assert not refused.successful and 'nmpc, pose_controller' in refused.reason
    assert node._supervisor.active == 'nmpc' and not put('takeoff_height', 2.0).successful


def test_an_active_controller_outside_the_supervisors_list_is_refused(make):
    with pytest.raises(ParameterError, match="'controller': expected one of nmpc, rl, found 'x'"):
        make(SupervisorNode, 'controller:=x')


def test_the_plan_of_a_graph_with_another_controller(tmp_path):
    nodes, _ = graph.plan(OWN, actuators='direct', bag='/b', task='hover')
    known = ['pose_controller', *registry.STANDING_BY]
    assert nodes['pose_controller_node'] == {'controller': OWN}
    assert nodes['supervisor_node']['controller'] == 'pose_controller'
    for name in ('supervisor_node', 'recorder_node'):
        assert nodes[name]['controllers'] == known
    command = graph.commands(nodes, tmp_path)[graph.COMPOSED]
    assert OWN in command and 'ekf_node' in command
    alone, _ = graph.plan(OWN, actuators='direct', standby=False)
    assert list(alone) == ['ekf_node', 'pose_controller_node', 'supervisor_node', 'sim_node']
