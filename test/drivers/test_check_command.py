"""`beetle_omni check` from the command line: table, JSON, exit status, one-line refusals."""

import json
import sys

import pytest

pytest.importorskip('dynamixel_sdk')
pytest.importorskip('pymavlink')

from check_helpers import QUICK, repeated
import serial

from beetle_omni_ros import cli
from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.drivers.check import run_check
from beetle_omni_ros.drivers.findings import ObservedGraph
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

PATIENT = """/**/joint_bridge_node:
  ros__parameters:
    port: /dev/nothing
    ids: [1, 2, 3, 4]
    signs: [1, 1, 1, 1]
    zeros: [2048, 2048, 2048, 2048]
    reply_time: 0.05
"""


@pytest.fixture
def robot(tmp_path):
    """Servo bus, motor board, and the arguments with their ports."""
    file = tmp_path / 'bus.yaml'
    file.write_text(PATIENT)
    with EmulatedServoBus() as bus, EmulatedMotorBoard(parameters=QUICK) as board:
        yield bus, board, ['check', '--servo-bus', str(file), '--servo-port', bus.port,
                           '--board-port', board.port, '--seconds', '1']


def checked(arguments, path):
    status = cli.main([*arguments, '--json', str(path)])
    return status, json.loads(path.read_text())


@pytest.mark.real_time
def test_a_good_robot_ends_with_status_0(robot, tmp_path, capsys):
    _, _, arguments = robot
    status, result = repeated(
        lambda: checked([*arguments, '--skip', 'ros'], tmp_path / 'result.json'),
        lambda answer: answer[0] == 0)
    assert status == 0 and result['ok']
    assert {row['part'] for row in result['findings']} == {'servos', 'board'}
    assert {row['level'] for row in result['findings']} <= {'ok', 'warn'}
    assert set(result['findings'][0]) == {'part', 'item', 'level', 'found', 'remedy', 'values'}
    assert result['meta']['skipped'] == ['ros']
    out = capsys.readouterr().out
    assert 'gimbal4' in out and 'not checked: ros' in out and '0 failed' in out


@pytest.mark.real_time
def test_without_ros_the_other_parts_are_checked(robot, tmp_path, monkeypatch):
    _, _, arguments = robot
    for name in [name for name in sys.modules if name.startswith('beetle_omni_ros.ros')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    monkeypatch.setitem(sys.modules, 'diagnostic_msgs', None)
    monkeypatch.setitem(sys.modules, 'diagnostic_msgs.msg', None)
    status, result = checked([*arguments, '--skip', 'board'], tmp_path / 'result.json')
    assert status == 1
    assert [row['item'] for row in result['findings'] if row['part'] == 'servos']
    (ros,) = [row for row in result['findings'] if row['part'] == 'ros']
    assert 'not installed' in ros['found'] and '[ros]' in ros['remedy']


@pytest.mark.real_time
def test_a_port_in_use_by_the_bridge_is_not_opened(robot, tmp_path):
    bus, _, _ = robot
    graph = ObservedGraph(0, 1.0, {}, {'joint_bridge': 'ready'},
                  {'joint_bridge_node: gimbal2': Diagnostic(0.0, 'status', 2, 'overload', {})})
    path, packets = tmp_path / 'result.json', []
    bus.handle = lambda packet, *_: packets.append(packet) or []
    with serial.Serial(bus.port, exclusive=True):
        status = run_check(listen=lambda _: graph, servo_port=bus.port, skip=('board',),
                           json_path=path)
    rows = {row['item']: row for row in json.loads(path.read_text())['findings']}
    assert status == 1 and not packets
    assert rows['servo port']['level'] == rows['joint_bridge state']['level'] == 'ok'
    assert rows['joint_bridge gimbal2']['level'] == 'fail'
    assert rows['joint_bridge gimbal2']['part'] == 'ros'
