"""Fixtures of ROS tests: checked field types, a reserved local ROS domain for each test."""

from contextlib import ExitStack
import os

os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

import pytest

pytest.importorskip('rclpy')

import rclpy

from beetle_omni_ros.nodes import graph


@pytest.fixture
def ros_domain(monkeypatch):
    """Hold a free ROS domain for one test, so that tests can run at the same time."""
    with graph.reserved_domain() as number:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
        yield number


@pytest.fixture
def make(ros_domain):
    """Make one node in this process, with parameters such as 'seed:=3'."""
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


@pytest.fixture
def make_bench(ros_domain):
    """Make a bench of nodes in this process, with parameters as for ``make``."""
    from witness import Bench
    with ExitStack() as stack:
        def build(*overrides, **options):
            made = Bench(ros_domain, *overrides, **options)
            stack.callback(made.close)
            return made
        yield build


@pytest.fixture
def bench(make_bench):
    return make_bench()
