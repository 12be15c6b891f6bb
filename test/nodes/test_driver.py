"""Manual driving through ROS: lines of text, a joystick, and refusals."""

import os
import subprocess
import sys

import numpy as np
import pytest
from sensor_msgs.msg import Joy
from witness import READY, Witness

from beetle_omni_ros.drive.parameters import DriveParameters
from beetle_omni_ros.messages.topics import EVENT
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.robot import rotations

NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node')


@pytest.fixture
def flight(ros_domain, tmp_path):
    """A graph in simulated time without targets; (domain, witness)."""
    graph = Graph({name: {} for name in NODES}, tmp_path, ros_domain, simulated=True)
    witness = None
    try:
        graph.start()
        witness = Witness(ros_domain)
        assert witness.wait(lambda: witness.ready, READY), graph.dead()
        yield ros_domain, witness
    finally:
        graph.stop()
        if witness:
            witness.close()


def drive(source, domain):
    return subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'drive', source,
         '--domain-id', str(domain)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, 'COLUMNS': '300'})


def test_lines_of_text_fly_the_robot_within_the_fence(flight):
    domain, witness = flight
    driver = drive('terminal', domain)
    driver.stdin.write('up 1\narm\nwait\njump\ngoto 40 0 1\nup 0.4\nroll 60\nwait\nwhere\n')
    driver.stdin.close()
    driver.stdin = None
    witness.wait(lambda: driver.poll() is not None, 60)
    output, error = driver.communicate(timeout=10)
    assert driver.returncode == 0, output + error
    lines = iter(output.splitlines())
    for part in ('arm first', 'arm: ', "'jump': expected", 'the fence', 'flying:nmpc; at', 'left'):
        assert any(part in line for line in lines), output
    truth = witness.truth
    assert truth.position[2] == pytest.approx(1.4, abs=0.1)
    assert rotations.geodesic_angle(truth.quaternion, rotations.from_rpy(
        np.radians(60), 0, rotations.to_rpy(truth.quaternion)[2])) < np.radians(8)


def test_a_stick_moves_the_robot_at_its_speed_and_a_silent_joystick_holds_it(flight):
    domain, witness = flight
    p, driver = DriveParameters.load(), drive('joystick', domain)
    joy = witness._node.create_publisher(Joy, 'joy', wire.profile(EVENT))

    def push(seconds, **values):
        message = Joy(axes=[0.0] * 8, buttons=[0] * 11)
        for name, value in values.items():
            if name == 'x':
                message.axes[int(p.axes[0])] = value * float(p.signs[0])
            else:
                message.buttons[p.buttons[name]] = value
        for _ in range(round(seconds / 0.05)):
            joy.publish(message)
            witness.spin(0.05)

    try:
        assert witness.wait(joy.get_subscription_count, 30)
        witness.spin(1.0)
        for _ in range(5):
            push(0.5)
            push(0.5, arm=1)
            if witness.wait(lambda: witness.state.startswith('flying'), 8):
                break
        assert witness.state.startswith('flying'), witness.states
        begin, at = witness.truth.position[0], witness.time()
        push(2.0, x=1.0)
        pushed = witness.time() - at + p.joystick_timeout
        witness.spin(1.0)
        assert witness.wait(lambda: np.linalg.norm(witness.truth.velocity) < 0.02, 20)
        moved = witness.truth.position[0] - begin
        assert 0.4 < moved < pushed * p.speed + 0.1
        witness.spin(1.0)
        assert witness.truth.position[0] - begin == pytest.approx(moved, abs=0.05)
    finally:
        driver.terminate()
        driver.communicate(timeout=10)


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['wheel'], "source 'wheel': expected keyboard or joystick or terminal"),
    (['keyboard'], 'standard input is no terminal'),
    (['terminal', '--params', 'none.yaml'], 'none.yaml'),
    (['terminal', '--poses', 'none.yaml'], 'none.yaml'),
    (['terminal', '--domain-id', '300'], "--domain-id '300': expected")])
def test_an_unusable_source_is_refused_in_one_line(capsys, monkeypatch, arguments, expected):
    from beetle_omni_ros import cli
    monkeypatch.setattr(sys, 'stdin', open(os.devnull))
    assert cli.main(['drive', *arguments]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert expected in line


def test_without_a_graph_the_missing_topic_is_named(ros_domain, monkeypatch, capfd):
    from beetle_omni_ros.nodes import driver
    monkeypatch.setattr(driver, 'SUPERVISOR_TIMEOUT', 0.3)
    assert driver.run_drive('terminal', domain_id=ros_domain) == 1
    lines = [one for one in capfd.readouterr().err.splitlines() if one.startswith('beetle')]
    line, = lines
    assert 'supervisor_node: not seen' in line and 'expected a running graph' in line
