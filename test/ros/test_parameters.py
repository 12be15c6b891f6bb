"""Parameters: files, overrides, one-line refusals, changes in flight."""

from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from beetle_omni_ros.model.schema import group, parameter
from beetle_omni_ros.ros import node as parameters


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Nested group."""

    kp: float = parameter(2.0, doc='stiffness', unit='1/s', low=0, high=10)
    axes: np.ndarray = parameter([[1, 0], [0, 1]], doc='axes', shape=(2, 2))


@dataclass(frozen=True, kw_only=True)
class Example:
    """Parameters of all types."""

    gains: Gains = group(Gains)
    mode: str = parameter('slow', doc='speed', choices=('slow', 'fast'))
    count: int = parameter(3, doc='number', low=1, high=5)
    active: bool = parameter(True, doc='switch')
    seed: int = parameter(0, doc='seed')


@pytest.fixture
def make_node(ros_domain):
    """Make a node with command line arguments, and destroy it afterwards."""
    with ExitStack() as stack:
        def make(*arguments):
            context = rclpy.Context()
            rclpy.init(args=['--ros-args', *arguments], context=context, domain_id=ros_domain)
            stack.callback(context.try_shutdown)
            node = Node('example', context=context)
            stack.callback(node.destroy_node)
            return node
        yield make


def test_file_and_overrides_arrive_in_the_dataclass(make_node, tmp_path):
    file = tmp_path / 'example.yaml'
    file.write_text('/**/example:\n  ros__parameters:\n    gains: {kp: 6.5}\n    count: 2\n')
    node = make_node('--params-file', str(file), '-p', 'gains.kp:=4', '-p', 'mode:=fast',
                     '-p', 'gains.axes:=[1.,2.,3.,4.]')
    given = parameters.declare(node, Example)
    assert given.gains.kp == 4.0 and given.mode == 'fast' and given.count == 2
    assert given.gains.axes.tolist() == [[1, 2], [3, 4]]
    assert node.get_parameter('gains.kp').value == 4.0
    descriptor = node.describe_parameter('gains.kp')
    assert 'stiffness' in descriptor.description
    assert descriptor.additional_constraints == '0 to 10'


def test_changes_in_flight_are_validated(make_node):
    node, seen = make_node(), []
    parameters.declare(node, Example, on_change=seen.append, changeable=('gains.', 'mode'))

    def set_to(name, value):
        return node.set_parameters([Parameter(name, value=value)])[0]

    assert set_to('gains.kp', 5.0).successful and seen[-1].gains.kp == 5.0
    assert set_to('mode', 'fast').successful and seen[-1].gains.kp == 5.0
    refused = set_to('mode', 'warp')
    assert not refused.successful and 'slow, fast' in refused.reason
    assert not set_to('gains.kp', 11.0).successful
    assert not set_to('seed', 4).successful
    assert node.get_parameter('gains.kp').value == 5.0
    assert len(seen) == 2
