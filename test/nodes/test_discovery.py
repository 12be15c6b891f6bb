"""Discovery is limited to this computer unless another range is requested."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from beetle_omni_ros.nodes import discovery, plan
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.robot.schema import ParameterError

PROBE = ('import os, sys\n'
         'from beetle_omni_ros.nodes import runner\n'
         'class ProbeNode:\n'
         '    def __init__(self):\n'
         '        raise runner.ParameterError(os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE"))\n')


@pytest.fixture
def unset(monkeypatch):
    for name in (*discovery.ROS_SETTINGS, discovery.VARIABLE):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'BEETLE_OMNI_DISCOVERY': ''}, 'LOCALHOST'),
    ({'BEETLE_OMNI_DISCOVERY': 'SUBNET'}, 'SUBNET'),
    ({'BEETLE_OMNI_DISCOVERY': 'subnet', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, 'SUBNET'),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    discovery.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds


def test_an_unknown_range_is_refused():
    with pytest.raises(ParameterError, match='expected one of LOCALHOST, SUBNET'):
        discovery.confine({'BEETLE_OMNI_DISCOVERY': 'world'})


@pytest.mark.parametrize('start', [
    'runner.main(ProbeNode, ["probe"])', 'sys.exit(runner.run([ProbeNode], ["x"], "composed"))'])
def test_every_separate_or_composed_node_is_limited_to_this_computer(ros_domain, unset, start):
    done = subprocess.run([sys.executable, '-c', PROBE + start], capture_output=True, text=True,
                          check=False, timeout=60)
    assert done.stderr.strip() == 'probe_node: error: LOCALHOST'
    done = subprocess.run([sys.executable, '-c', PROBE + start], capture_output=True, text=True,
                          check=False, timeout=60,
                          env={**os.environ, 'BEETLE_OMNI_DISCOVERY': 'subnet'})
    assert done.stderr.strip() == 'probe_node: error: SUBNET'


def test_an_argument_of_a_node_sets_the_range(ros_domain, unset):
    def start(*arguments):
        code = f'{PROBE}runner.main(ProbeNode, ["probe", *{list(arguments)!r}])'
        return subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                              check=False, timeout=60).stderr.strip()

    assert start('--discovery', 'SUBNET') == 'probe_node: error: SUBNET'
    assert start('--discovery=off', '--ros-args', '-p', 'a:=1') == 'probe_node: error: OFF'
    for bad in (('--discovery', 'world'), ('--discovery',)):
        assert start(*bad).startswith('probe_node: error: --discovery: expected one of LOCALHOST')


def test_the_range_argument_of_a_composition_is_not_a_node(ros_domain, unset):
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.start', 'composed', '--discovery', 'subnet',
         'no_node'], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2 and "unknown node 'no_node'" in done.stderr


@pytest.mark.parametrize('command', ['fly', 'check'])
def test_commands_that_join_the_graph_have_the_discovery_argument(command):
    done = subprocess.run([sys.executable, '-m', 'beetle_omni_ros.cli', command, '--help'],
                          capture_output=True, text=True, check=False, timeout=60)
    assert '--discovery' in done.stdout


def test_an_argument_of_fly_holds_for_the_processes_that_it_starts(tmp_path, unset, monkeypatch):
    monkeypatch.setenv(discovery.RANGE, 'LOCALHOST')        # put back afterwards
    monkeypatch.setenv(discovery.VARIABLE, '')
    given = {}
    monkeypatch.setattr(subprocess, 'Popen', lambda *_, env, **__: given.update(env))
    discovery.confine(requested='subnet')
    Graph({'ekf_node': {}}, tmp_path, 7).start_process('composed')
    assert given['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'


def test_a_graph_is_limited_to_this_computer(tmp_path, unset, monkeypatch):
    given = {}
    monkeypatch.setattr(subprocess, 'Popen', lambda *_, env, **__: given.update(env))
    Graph({'ekf_node': {}}, tmp_path, 7).start_process('composed')
    assert given['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'


@pytest.mark.parametrize('composed', [True, False])
def test_an_argument_of_fly_reaches_every_node_of_the_plan(tmp_path, unset, monkeypatch, composed):
    monkeypatch.setenv(discovery.RANGE, 'LOCALHOST')        # put back afterwards
    monkeypatch.setenv(discovery.VARIABLE, '')
    started = {}

    def start(arguments, env, **_):
        started[arguments[2]] = env[discovery.RANGE], arguments
        return SimpleNamespace(poll=lambda: 0, returncode=0)

    monkeypatch.setattr(subprocess, 'Popen', start)
    monkeypatch.setattr(os.path, 'exists', lambda _: True)
    discovery.confine(requested='subnet')
    nodes = plan.plan(plan.GraphOptions(controller='hover', ports=str(tmp_path), task='hover',
                                        bag=str(tmp_path / 'bag'))).nodes
    graph = Graph(nodes, tmp_path, 7, composed)
    graph.start()
    assert len(graph.processes) == (2 if composed else len(nodes))
    assert {value for value, _ in started.values()} == {'SUBNET'}


def test_a_name_is_free_again_when_its_process_ends():
    name = f'test/{os.getpid()}'
    with discovery.claim(name):
        assert discovery.claim(name) is None
    code = f'from beetle_omni_ros.nodes import discovery; print(discovery.claim({name!r}))'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=True, timeout=60)
    assert 'socket' in done.stdout
    with discovery.claim(name):
        pass


def test_two_reserved_domains_differ(monkeypatch):
    with discovery.reserved_domain() as first:
        monkeypatch.setattr(discovery, '_starts', iter([discovery.DOMAINS.index(first)]))
        with discovery.reserved_domain() as second:
            assert second != first
