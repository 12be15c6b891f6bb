"""Discovery is limited to this computer unless another range is requested."""

import pytest

from beetle_omni_ros.nodes import graph


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    graph.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds


def test_two_reserved_domains_differ(monkeypatch):
    with graph.reserved_domain() as first:
        monkeypatch.setattr(graph, '_starts', iter([graph.DOMAINS.index(first)]))
        with graph.reserved_domain() as second:
            assert second != first
