"""Fixtures of ROS tests: checked field types, a reserved local ROS domain for each test."""

from contextlib import ExitStack
import os

os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'

import pytest

pytest.importorskip('rclpy')

from beetle_omni_ros.ros import graph


@pytest.fixture
def ros_domain(monkeypatch):
    """Hold a free ROS domain for one test, so that tests can run at the same time."""
    with graph.reserved_domain() as number:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
        yield number


@pytest.fixture
def make_bench(ros_domain):
    """Make a bench of nodes in this process, with parameters such as 'seed:=3'."""
    from witness import Bench
    with ExitStack() as stack:
        def build(*overrides, **options):
            made = Bench(ros_domain, *overrides, **options)
            stack.callback(made.close)
            return made
        yield build


@pytest.fixture
def make(make_bench):
    """Make one node in this process, with parameters such as 'seed:=3'."""
    return lambda node_class, *overrides: make_bench(*overrides).add(node_class())


@pytest.fixture
def bench(make_bench):
    return make_bench()
