"""Manual driving through ROS: keys, lines of text, a joystick, and refusals."""

from contextlib import closing
import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
from types import SimpleNamespace

import numpy as np
import pytest
from witness import running_graph

from beetle_omni_ros import cli
from beetle_omni_ros.drive import DriveParameters
from beetle_omni_ros.messages.topics import EVENT
from beetle_omni_ros.nodes import driver, wire
from beetle_omni_ros.nodes.graph import in_simulated_time, reserved_domain
from beetle_omni_ros.robot import rotations

NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node')
STEP = DriveParameters.load().step
LOCAL_FLAGS = 3     # index in the list of termios
PATIENCE = 60       # [s]


@pytest.fixture(scope='module')
def graph(tmp_path_factory):
    """A graph in simulated time without targets; (domain, witness)."""
    with reserved_domain() as domain, running_graph(
            in_simulated_time({name: {} for name in NODES}), tmp_path_factory.mktemp('graph'),
            domain) as (_, witness):
        yield domain, witness


@pytest.fixture
def flight(graph):
    """The same, landed."""
    _, witness = graph
    if witness.state != 'disarmed':
        assert witness.call('land')[0]
        assert witness.wait(lambda: witness.state == 'disarmed', PATIENCE), witness.states
    return graph


class Terminal:
    """A terminal with `beetle_omni drive keyboard`, started like by a shell."""

    def __init__(self, domain):
        self.mine, self.its = pty.openpty()
        self.before = termios.tcgetattr(self.its)
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'drive', 'keyboard',
             '--domain-id', str(domain)], stdin=self.its, stdout=self.its, stderr=self.its,
            env={**os.environ, 'COLUMNS': '300', 'TERM': 'xterm'}, preexec_fn=self._control)
        self.text = ''

    def _control(self):
        """Make it the controlling terminal, so that Ctrl-C reaches the program."""
        os.setsid()
        fcntl.ioctl(self.its, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def press(self, keys):
        os.write(self.mine, keys.encode())

    def shows(self, text):
        while select.select([self.mine], [], [], 0)[0]:
            self.text += os.read(self.mine, 4096).decode()
        return text in self.text

    @property
    def state(self):
        return termios.tcgetattr(self.its)

    @property
    def echoes(self):
        return bool(self.state[LOCAL_FLAGS] & termios.ECHO)

    def close(self):
        self.process.kill()
        self.process.wait()
        os.close(self.mine)
        os.close(self.its)


def test_keys_become_targets_and_ctrl_c_restores_the_terminal(flight):
    domain, witness = flight
    with closing(Terminal(domain)) as terminal:
        assert witness.wait(lambda: terminal.shows('q quit'), PATIENCE), terminal.text
        targets = []
        wire.subscribe(witness._node, 'target_pose', targets.append, qos=EVENT)
        assert witness.wait(lambda: not terminal.echoes, 10)
        terminal.press('w')
        assert witness.wait(lambda: terminal.shows('arm first'), PATIENCE), terminal.text
        terminal.press('t')
        assert witness.wait(lambda: witness.state.startswith('flying'), PATIENCE), terminal.text
        witness.spin(2.0)
        begin = witness.truth.position
        terminal.press('www' + 'r' * 4 + '?')
        assert witness.wait(lambda: targets and abs(
            targets[-1].position[0] - begin[0] - 3 * STEP) < 0.5 * STEP, PATIENCE), terminal.text
        assert witness.wait(lambda: abs(
            targets[-1].position[2] - begin[2] - 4 * STEP) < 0.5 * STEP, PATIENCE), targets[-1]
        assert len(targets) > 3     # at the speed, not at once
        assert witness.wait(lambda: abs(
            witness.truth.position[2] - targets[-1].position[2]) < 0.1, PATIENCE)
        terminal.press('\x03')
        assert witness.wait(lambda: terminal.shows('its last target')
                            and terminal.process.poll() is not None, PATIENCE), terminal.text
        assert terminal.process.poll() == 130 and 'Traceback' not in terminal.text
        assert terminal.state == terminal.before and witness.state.startswith('flying')


def test_lines_of_text_fly_the_robot_within_the_fence(flight):
    domain, witness = flight
    driver = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'drive', 'terminal',
         '--domain-id', str(domain)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, 'COLUMNS': '300'})
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


def test_sticks_and_buttons_are_actions_until_the_joystick_is_silent():
    p = DriveParameters.load()
    pilot = SimpleNamespace(axes=[0.0] * 8, buttons=[0] * 11, joy_at=5.0, steering=object(),
                            time=lambda: 5.0)
    joystick = driver._Joystick(pilot, p, {}, print)
    assert joystick.actions(0.1) == []
    pilot.axes[int(p.axes[0])], pilot.buttons[p.buttons['arm']] = float(p.signs[0]), 1
    order, shift = joystick.actions(0.1)
    assert order.name == 'arm' and shift.values[0] == pytest.approx([0.1 * p.speed, 0, 0])
    assert len(joystick.actions(0.1)) == 1      # the button is still pressed
    pilot.time = lambda: 5.0 + 2 * p.joystick_timeout
    assert joystick.actions(0.1) == []


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['wheel'], "source 'wheel': expected keyboard or joystick or terminal"),
    (['keyboard'], 'standard input is no terminal'),
    (['terminal', '--poses', 'none.yaml'], 'none.yaml'),
    (['terminal', '--domain-id', '300'], "--domain-id '300': expected")])
def test_an_unusable_source_is_refused_in_one_line(capsys, monkeypatch, arguments, expected):
    monkeypatch.setattr(sys, 'stdin', open(os.devnull))
    assert cli.main(['drive', *arguments]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert expected in line
