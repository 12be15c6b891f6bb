"""Manual driving by keys: targets from keys, and the restored terminal."""

from contextlib import contextmanager
import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time

import pytest
from witness import READY, Witness

from beetle_omni_ros.drive.parameters import DriveParameters
from beetle_omni_ros.messages.topics import EVENT
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import Graph

NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node')
STEP = DriveParameters.load().step
LOCAL_FLAGS = 3     # index in the list of termios
PATIENCE = 60       # [s]


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
        """Whether the program has printed ``text``."""
        while select.select([self.mine], [], [], 0)[0]:
            self.text += os.read(self.mine, 4096).decode()
        return text in self.text

    @property
    def state(self):
        return termios.tcgetattr(self.its)

    @property
    def echoes(self):
        return bool(self.state[LOCAL_FLAGS] & termios.ECHO)

    def ends(self, witness):
        """Exit status of the program."""
        assert witness.wait(lambda: self.shows('') or self.process.poll() is not None, PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while self.process.poll() is None and time.monotonic() < deadline:
            self.shows('')
            time.sleep(0.05)
        self.shows('')
        return self.process.poll()

    def close(self):
        self.process.kill()
        self.process.wait()
        os.close(self.mine)
        os.close(self.its)


@pytest.fixture
def graph(ros_domain, tmp_path):
    """A graph in simulated time; (domain, witness)."""
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


@contextmanager
def driving(graph):
    """A driving terminal that shows its keys."""
    domain, witness = graph
    terminal = Terminal(domain)
    try:
        assert witness.wait(lambda: terminal.shows('q quit'), PATIENCE), terminal.text
        yield witness, terminal
    finally:
        terminal.close()


def test_keys_become_targets_and_each_end_restores_the_terminal(graph):
    """One graph for all, because its start takes longer."""
    with driving(graph) as (witness, terminal):
        ctrl_c_restores_the_terminal(witness, terminal)
    with driving(graph) as (witness, terminal):
        a_terminal_that_closes_ends_the_driver(witness, terminal)
    with driving(graph) as (witness, terminal):
        keys_become_targets_and_q_restores_the_terminal(witness, terminal)


def ctrl_c_restores_the_terminal(witness, terminal):
    assert witness.wait(lambda: not terminal.echoes, 10)
    terminal.press('\x03')
    assert terminal.ends(witness) == 130
    assert 'Traceback' not in terminal.text
    assert 'left; the robot holds its last target' in terminal.text
    assert terminal.state == terminal.before


def a_terminal_that_closes_ends_the_driver(witness, terminal):
    terminal.press('\x04')      # Ctrl-D is no end of input if keys are read one by one
    witness.spin(0.5)
    assert terminal.process.poll() is None
    os.close(terminal.mine)
    assert witness.wait(lambda: terminal.process.poll() is not None, PATIENCE)
    terminal.mine = os.open(os.devnull, os.O_RDONLY)


def keys_become_targets_and_q_restores_the_terminal(witness, terminal):
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
    assert witness.wait(lambda: abs(witness.truth.position[2] - targets[-1].position[2]) < 0.1,
                        PATIENCE)
    terminal.press('q')
    assert terminal.ends(witness) == 0
    assert 'left; the robot holds its last target' in terminal.text
    assert terminal.state == terminal.before and witness.state.startswith('flying')
