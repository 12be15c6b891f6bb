"""Discovery is limited to this computer unless another range is requested."""

import os
import subprocess
from types import SimpleNamespace

import pytest

from beetle_omni_ros.nodes import graph
from beetle_omni_ros.robot.schema import ParameterError


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'BEETLE_OMNI_DISCOVERY': ''}, 'LOCALHOST'),
    ({'BEETLE_OMNI_DISCOVERY': 'SUBNET'}, 'SUBNET'),
    ({'BEETLE_OMNI_DISCOVERY': 'subnet', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, 'SUBNET'),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    graph.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds
    with pytest.raises(ParameterError, match='expected one of LOCALHOST, SUBNET'):
        graph.confine({'BEETLE_OMNI_DISCOVERY': 'world'})


def test_an_argument_of_fly_reaches_both_processes(tmp_path, monkeypatch):
    for name in (*graph.ROS_SETTINGS, graph.VARIABLE):
        monkeypatch.setenv(name, '')        # put back afterwards
    ranges = []

    def start(arguments, env, **_):
        ranges.append(env[graph.RANGE])
        return SimpleNamespace(poll=lambda: 0, returncode=0)

    monkeypatch.setattr(subprocess, 'Popen', start)
    monkeypatch.setattr(os.path, 'exists', lambda _: True)
    graph.confine(requested='subnet')
    nodes, _ = graph.plan('hover', ports=str(tmp_path))
    graph.Graph(nodes, tmp_path, 7).start()
    assert ranges == ['SUBNET'] * 2


def test_two_reserved_domains_differ(monkeypatch):
    with graph.reserved_domain() as first:
        monkeypatch.setattr(graph, '_starts', iter([graph.DOMAINS.index(first)]))
        with graph.reserved_domain() as second:
            assert second != first
