"""`beetle_omni check` finds each fault of the devices, with a remedy, and changes nothing."""

import json
import sys

import pytest

pytest.importorskip('dynamixel_sdk')
pytest.importorskip('pymavlink')

from check_helpers import board, levels, QUICK, repeated, servos
import numpy as np
import serial
from servo_bench import running

from beetle_omni_ros import cli
from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.drivers import device_checks, mavlink
from beetle_omni_ros.drivers.check import ObservedGraph, run_check
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

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
    with EmulatedServoBus() as bus, EmulatedMotorBoard(**QUICK) as board:
        yield bus, board, ['check', '--servo-bus', str(file), '--servo-port', bus.port,
                           '--board-port', board.port, '--seconds', '1']


def checked(arguments, path):
    status = cli.main([*arguments, '--json', str(path)])
    return status, json.loads(path.read_text())


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


# --- servo bus ----------------------------------------------------------------------------------

NAMES = [f'gimbal{k}' for k in (1, 2, 3, 4)]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(device_checks, 'ROUNDS', 5)


def test_a_good_bus_passes_and_its_measurements_are_reported():
    with EmulatedServoBus() as emulated:
        found = servos(emulated.port)
    assert levels(found) == {}
    assert list(found) == ['servo port', 'servo bus', *NAMES]
    assert found['gimbal3'].values == pytest.approx({
        'id': 3, 'model': 1210, 'firmware': 52, 'baud_rate': 1_000_000, 'supply_V': 12.0,
        'temperature_C': 35.0, 'position_rad': 0.0})
    assert found['servo bus'].values['asked'] == 20


def test_torque_that_was_on_before_stays_on_and_is_reported():
    with running() as (bus, emulated):
        bus.link.close()       # the driver has ended, and the guard is not used
        found = servos(emulated.port)
        assert all(emulated.drive()[1])
    assert levels(found) == {f'{name} torque': 'warn' for name in NAMES}


def turned(emulated):
    emulated.set_state(np.array([0.0, 2.8, 0.0, -1.0]), np.zeros(4), np.zeros(4))


def hot(emulated):
    emulated.servos[3]['Temperature Limit'] = 50
    emulated.servos[3]['Present Temperature'] = 80


def put(**faults):
    return lambda emulated: [setattr(emulated.faults, *item) for item in faults.items()]


# what is wrong, levels that are not ok, item, its words
FAULTS = {
    'missing': (put(silent={4}), {'gimbal4': 'fail'}, 'gimbal4', ('connector',)),
    'empty': (put(silent={1, 2, 3, 4}), {'servo bus': 'fail'}, 'servo bus', ('supply',)),
    **{f'{volts} V': (put(supply_voltage=volts), {
        f'{name} supply': level for name in NAMES}, 'gimbal1 supply', ())
       for volts, level in ((6.0, 'fail'), (9.0, 'warn'))},
    'hot': (hot, {'gimbal4': 'fail', 'gimbal4 temperature': 'warn'}, 'gimbal4', ()),
    'turn': (turned, {'gimbal2 turn': 'fail'}, 'gimbal2 turn',
             ('-3.48 or +2.80 rad', '2.32 rad')),
    'line': (put(bad_crc=0.4), {'servo bus': 'fail'}, 'servo bus', ())}


@pytest.mark.parametrize('name', FAULTS)
def test_each_fault_of_the_bus_is_found_and_named(name):
    break_it, bad, item, words = FAULTS[name]
    with EmulatedServoBus() as emulated:
        break_it(emulated)
        asked, handle = set(), emulated.handle
        emulated.handle = lambda packet, *rest: asked.add(packet[1]) or handle(packet, *rest)
        found = repeated(lambda: servos(emulated.port), lambda found: levels(found) == bad)
    # A bad line may hide servos too.
    assert levels(found) == bad or name == 'line' and levels(found).items() > bad.items()
    assert asked <= {1, 2}      # ping and read: no register is written
    text = found[item].found + found[item].remedy
    assert all(word in text for word in words), text


# --- motor board --------------------------------------------------------------------------------

ALL = ['board port', 'board firmware', 'board receives host',
       'board ready to arm', 'battery', *(f'ESC of rotor {k}' for k in (1, 2, 3, 4)),
       'board clock', 'link from the board', 'link to the board']


@pytest.fixture
def emulated():
    with EmulatedMotorBoard(**QUICK) as made:
        yield made


def board_with(emulated, bad, **changes):
    """Findings once exactly the items of ``bad`` (item -> level) are not ok."""
    found = repeated(lambda: board(emulated.port, **changes), lambda f: levels(f) == bad)
    assert levels(found) == bad
    return found


def test_a_good_board_passes_and_stays_disarmed(emulated):
    found = board_with(emulated, {})
    assert list(found) == ALL
    assert found['battery'].values['cell_V'] == pytest.approx(4.2, abs=0.01)
    assert 0 < found['board clock'].values['uncertainty_s'] < 0.02
    assert not emulated.armed


def volts(volts):
    return lambda emulated: emulated.set_battery(volts, 0.0)


@pytest.mark.parametrize(('break_it', 'changes', 'bad', 'words'), [
    (volts(20.0), {}, {'battery': 'fail', 'board ready to arm': 'fail'}, '3.33 V a cell of 6'),
    (volts(21.6), {}, {'battery': 'warn'}, '3.60 V a cell of 6'),
    (put(failed_escs=(2,)), {}, {'ESC of rotor 2': 'fail', 'board ready to arm': 'fail'},
     'offline'),
    (put(corrupt_in=0.5, drop_out=0.05), {'seconds': 2.0},
     {'link to the board': 'fail', 'link from the board': 'warn'}, ''),
    (put(drop_in=1.0), {}, {'board receives host': 'fail', 'board clock': 'fail'}, 'TX wire')])
def test_each_fault_of_the_board_is_found_and_named(emulated, break_it, changes, bad, words):
    break_it(emulated)
    found = board_with(emulated, bad, **changes)[next(iter(bad))]
    assert words in found.found + found.remedy


def test_a_silent_or_foreign_board_ends_the_checks(emulated, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(mavlink, 'BOARD', (1, 7))
        found = board_with(emulated, {'motor board': 'fail'}, seconds=0.5)
    assert 'another device' in found['motor board'].remedy
    emulated.faults.drop_out = 1.0
    found = repeated(lambda: board(emulated.port, seconds=0.5),     # a frame may be under way
                     lambda found: '0 bytes' in found['motor board'].found)
    assert list(found) == ['board port', 'motor board']
    assert '0 bytes' in found['motor board'].found
    emulated.unplug()
    (port,) = board(emulated.port).values()
    assert port.level == 'fail' and 'no such port' in port.found
