"""Discovery is limited to this computer unless another range is requested."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from beetle_omni_ros.nodes import graph, runner
from beetle_omni_ros.robot.schema import ParameterError


@pytest.fixture
def unset(monkeypatch):
    for name in (*graph.ROS_SETTINGS, graph.VARIABLE):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'BEETLE_OMNI_DISCOVERY': ''}, 'LOCALHOST'),
    ({'BEETLE_OMNI_DISCOVERY': 'SUBNET'}, 'SUBNET'),
    ({'BEETLE_OMNI_DISCOVERY': 'subnet', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, 'SUBNET'),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    graph.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds


def test_an_unknown_range_is_refused():
    with pytest.raises(ParameterError, match='expected one of LOCALHOST, SUBNET'):
        graph.confine({'BEETLE_OMNI_DISCOVERY': 'world'})


@pytest.mark.parametrize(('arguments', 'variable', 'holds'), [
    ([], '', 'LOCALHOST'), ([], 'subnet', 'SUBNET'), (['--discovery', 'SUBNET'], '', 'SUBNET'),
    (['--discovery=off'], '', 'OFF')])
def test_a_process_of_nodes_is_limited_to_this_computer_unless_requested(
        unset, monkeypatch, arguments, variable, holds):
    def probe():
        raise ParameterError(os.environ[graph.RANGE])

    monkeypatch.setenv(graph.RANGE, '')        # put back afterwards
    monkeypatch.setenv(graph.VARIABLE, variable)
    failures = []
    monkeypatch.setattr(sys, 'argv', ['ekf_node', *arguments, '--ros-args'])
    monkeypatch.setattr(runner, 'node_class', lambda name: probe)
    monkeypatch.setattr(runner, '_fail', lambda name, error, status: failures.append(str(error)))
    monkeypatch.setattr(runner.signal, 'signal', lambda *_: None)
    with pytest.raises(SystemExit):
        runner.main('ekf_node')
    assert failures == [holds]


@pytest.mark.parametrize('composed', [True, False])
@pytest.mark.parametrize(('requested', 'holds'), [('', 'LOCALHOST'), ('subnet', 'SUBNET')])
def test_an_argument_of_fly_reaches_every_node_of_the_plan(tmp_path, unset, monkeypatch, composed,
                                                           requested, holds):
    monkeypatch.setenv(graph.RANGE, '')        # put back afterwards
    monkeypatch.setenv(graph.VARIABLE, '')
    ranges = []

    def start(arguments, env, **_):
        ranges.append(env[graph.RANGE])
        return SimpleNamespace(poll=lambda: 0, returncode=0)

    monkeypatch.setattr(subprocess, 'Popen', start)
    monkeypatch.setattr(os.path, 'exists', lambda _: True)
    graph.confine(requested=requested)
    nodes = graph.plan(graph.GraphOptions(controller='hover', ports=str(tmp_path), task='hover',
                                        bag=str(tmp_path / 'bag'))).nodes
    graph.Graph(nodes, tmp_path, 7, composed).start()
    assert ranges == [holds] * (2 if composed else len(nodes))


def test_two_reserved_domains_differ(monkeypatch):
    with graph.reserved_domain() as first:
        monkeypatch.setattr(graph, '_starts', iter([graph.DOMAINS.index(first)]))
        with graph.reserved_domain() as second:
            assert second != first
