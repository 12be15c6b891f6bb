"""Test bench of real flights: long timeouts, and an operator that observes the truth."""

from contextlib import contextmanager
import os
from pathlib import Path
import time

import numpy as np
import pytest
import rclpy
from rclpy.experimental.events_executor import EventsExecutor

from beetle_omni_ros.bags.topics import EVENT, SENSOR
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.graph import COMPOSED, Graph

HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'
BUSY = 0.85         # share of a core above which tests are not valid
READY = 240     # s; without a cache the controller is compiled first


def cpu_seconds(pid):
    """User and system time of a process [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


class Witness(Operator):
    """Operator that also observes truth and commands."""

    def __init__(self, domain):
        super().__init__(domain)
        self.truth, self.last_command, self.height_min = None, None, np.inf
        wire.subscribe(self._node, 'ground_truth/odom', self._on_truth, qos=SENSOR)
        wire.subscribe(self._node, 'command', self._on_actuators, qos=SENSOR)

    def _on_truth(self, truth):
        self.truth = truth
        self.height_min = min(self.height_min, truth.position[2])

    def _on_actuators(self, command):
        self.last_command = time.monotonic(), command

    def stays_in_the_air(self, seconds):
        """Observe for ``seconds``; return whether the robot stayed above half a metre."""
        self.height_min = np.inf
        self.spin(seconds)
        return 0.5 < self.height_min < np.inf

    def can_judge(self, graph):
        """Skip the test if the nodes cannot keep real time."""
        before, begin = cpu_seconds(graph.processes[COMPOSED].pid), time.monotonic()
        self.spin(1.0)
        used = cpu_seconds(graph.processes[COMPOSED].pid) - before
        if (busy := used / (time.monotonic() - begin)) > BUSY:
            pytest.skip(f'too slow for a flight in real time: the nodes use {busy:.0%} of a core')


@contextmanager
def running_graph(nodes, folder, domain, *, operator=Witness, ready=lambda one: one.ready,
                  **options):
    """Yield a graph of nodes (name -> parameters) and its operator once this is ready."""
    graph, witness = Graph(nodes, folder, domain, **options), None
    try:
        graph.start()
        witness = operator(domain)
        assert witness.wait(lambda: graph.dead() or ready(witness), READY)
        assert not graph.dead(), graph.dead()
        yield graph, witness
    finally:
        stubborn = graph.stop()
        if witness:
            witness.close()
    assert not stubborn


class Bench:
    """Nodes in this process, and one named ``user`` that publishes to them."""

    def __init__(self, domain, *overrides, user='user'):
        arguments = [a for override in overrides for a in ('-p', override)]
        rclpy.init(args=['--ros-args', *arguments], domain_id=domain)
        self.user = rclpy.create_node(user)
        self.executor = EventsExecutor()
        self.executor.add_node(self.user)
        self.nodes = [self.user]

    def add(self, node):
        """Spin this node too."""
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def publisher(self, kind, topic, profile=wire.profile(EVENT)):
        made = self.user.create_publisher(kind, topic, profile)
        assert self.wait(lambda: made.get_subscription_count())
        return made

    def wait(self, condition, timeout=20.0):
        end = time.monotonic() + timeout
        while not condition() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)
        return condition()

    def close(self):
        for node in self.nodes:
            self.executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()
