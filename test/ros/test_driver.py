"""Manual driving through ROS: keys, lines of text, a joystick."""

from contextlib import closing, suppress
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

from beetle_omni_ros.model import rotations
from beetle_omni_ros.ros import driver, wire
from beetle_omni_ros.ros.drive import DriveParameters
from beetle_omni_ros.ros.graph import in_simulated_time, reserved_domain

NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node')
LOCAL_FLAGS = 3     # index in the list of termios
PATIENCE = 60       # [s]


@pytest.fixture(scope='module')
def graph(tmp_path_factory):
    """A graph in simulated time without targets; (domain, witness)."""
    with reserved_domain() as domain, running_graph(
            in_simulated_time({name: {} for name in NODES}), tmp_path_factory.mktemp('graph'),
            domain) as (_, witness):
        yield domain, witness


class Terminal:
    """A terminal with `beetle_omni drive keyboard`, which Ctrl-C in it interrupts."""

    def __init__(self, domain):
        pid, self.mine = pty.fork()
        if not pid:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.environ.update(COLUMNS='300', TERM='xterm')
            os.execv(sys.executable, [
                sys.executable, '-m', 'beetle_omni_ros.start', 'beetle_omni', 'drive', 'keyboard',
                '--domain-id', str(domain)])
        self.pid, self.before, self.text = pid, termios.tcgetattr(self.mine), ''

    def press(self, keys):
        os.write(self.mine, keys.encode())

    def shows(self, text):
        with suppress(OSError):     # it has ended
            while select.select([self.mine], [], [], 0)[0]:
                self.text += os.read(self.mine, 4096).decode()
        return text in self.text

    @property
    def state(self):
        return termios.tcgetattr(self.mine)

    def close(self):
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        os.close(self.mine)


def test_a_key_is_answered_and_ctrl_c_restores_the_terminal(graph):
    domain, witness = graph
    with closing(Terminal(domain)) as terminal:
        assert witness.wait(lambda: terminal.shows('q quit'), PATIENCE), terminal.text
        assert witness.wait(lambda: not terminal.state[LOCAL_FLAGS] & termios.ECHO, 10)
        terminal.press('w')
        assert witness.wait(lambda: terminal.shows('arm first'), PATIENCE), terminal.text
        terminal.press('\x03')
        assert witness.wait(lambda: terminal.shows('its last target'), PATIENCE), terminal.text
        assert os.waitstatus_to_exitcode(os.waitpid(terminal.pid, 0)[1]) == 130
        assert 'Traceback' not in terminal.text and terminal.state == terminal.before


def test_lines_of_text_fly_the_robot_within_the_fence(graph):
    domain, witness = graph
    targets = []
    wire.subscribe(witness._node, 'target_pose', targets.append)
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
    assert len(targets) > 3     # at the speed, not at once
    truth = witness.truth
    assert truth.position[2] == pytest.approx(1.4, abs=0.1)
    assert rotations.geodesic_angle(truth.quaternion, rotations.from_rpy(
        np.radians(60), 0, rotations.to_rpy(truth.quaternion)[2])) < np.radians(8)


def test_sticks_and_buttons_are_actions_until_the_joystick_is_silent():
    p = DriveParameters.load()
    pilot = SimpleNamespace(axes=[0.0] * 8, buttons=[0] * 11, joy_at=5.0, steering=object(),
                            time=lambda: 5.0)
    actions = driver.joystick(pilot, p, print)
    assert next(actions) == []
    pilot.axes[int(p.axes[0])], pilot.buttons[p.buttons['arm']] = float(p.signs[0]), 1
    pilot.time = lambda: 5.1
    order, shift = next(actions)
    assert order == ('arm', ()) and shift[0] == 'shift'
    assert shift[1][0] == pytest.approx([0.1 * p.speed, 0, 0])
    pilot.time = lambda: 5.2
    assert len(next(actions)) == 1      # the button is still pressed
    pilot.time = lambda: 5.2 + 2 * p.joystick_timeout
    assert next(actions) == []
