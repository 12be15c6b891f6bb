"""Discovery is limited to this computer unless another range is requested."""

import os
import subprocess
from types import SimpleNamespace

import pytest

from beetle_omni_ros.nodes import graph


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    graph.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds


def test_the_setting_reaches_both_processes_of_a_flight(tmp_path, monkeypatch):
    monkeypatch.setenv(graph.RANGE, 'SUBNET')
    ranges = []

    def start(arguments, env, **_):
        ranges.append(env[graph.RANGE])
        return SimpleNamespace(poll=lambda: 0, returncode=0)

    monkeypatch.setattr(subprocess, 'Popen', start)
    monkeypatch.setattr(os.path, 'exists', lambda _: True)
    nodes, _ = graph.plan('hover', ports=str(tmp_path))
    graph.Graph(nodes, tmp_path, 7).start()
    assert ranges == ['SUBNET'] * 2


def test_two_reserved_domains_differ(monkeypatch):
    with graph.reserved_domain() as first:
        monkeypatch.setattr(graph, '_starts', iter([graph.DOMAINS.index(first)]))
        with graph.reserved_domain() as second:
            assert second != first
