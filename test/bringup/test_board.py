"""The check of the motor board finds each fault, with a remedy, and arms nothing."""

import sys

import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('dynamixel_sdk')

from check_helpers import board, levels, QUICK, repeated

from beetle_omni_ros.drivers import motor_board_state
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard

pytestmark = pytest.mark.real_time

ALL = ['board port', 'board port latency timer', 'board firmware', 'board receives host',
       'board ready to arm', 'battery', *(f'ESC of rotor {k}' for k in (1, 2, 3, 4)),
       'board clock', 'link from the board', 'link to the board']


@pytest.fixture
def emulated():
    """A motor board."""
    with EmulatedMotorBoard(parameters=QUICK) as made:
        yield made


def board_with(emulated, bad, **changes):
    """Check until exactly the items of ``bad`` (item -> level) are not ok; return the findings."""
    found = repeated(lambda: board(emulated.port, **changes), lambda f: levels(f) == bad)
    assert levels(found) == bad
    return found


def test_a_good_board_passes_and_stays_disarmed(emulated):
    found = board_with(emulated, {})
    assert list(found) == ALL
    assert found['battery'].values['cell_V'] == pytest.approx(4.2, abs=0.01)
    assert 0 < found['board clock'].values['uncertainty_s'] < 0.02
    assert not emulated.armed


def test_an_old_start_of_another_program_is_not_counted_as_loss(emulated):
    for _ in range(2):      # each leaves the board with a gap in the sequence
        board(emulated.port, seconds=0.3)
    assert emulated._parser.lost > 10
    board_with(emulated, {})


@pytest.mark.parametrize(('volts', 'level', 'blocks'), [
    (20.0, 'fail', True), (21.6, 'warn', False), (26.0, 'fail', False)])
def test_the_battery_is_judged_by_its_cells(emulated, volts, level, blocks):
    emulated.set_battery(volts, 0.0)
    bad = {'battery': level} | ({'board ready to arm': 'fail'} if blocks else {})
    found = board_with(emulated, bad)
    assert f'{volts / 6:.2f} V a cell of 6' in found['battery'].found
    assert ('battery low' in found['board ready to arm'].found) == blocks


def test_a_failed_esc_is_named(emulated):
    emulated.faults.failed_escs = (2,)
    found = board_with(emulated, {'ESC of rotor 2': 'fail', 'board ready to arm': 'fail'})
    assert found['ESC of rotor 2'].found == 'offline'


def test_losses_are_reported_for_each_direction(emulated):
    emulated.faults.corrupt_in = 0.5
    emulated.faults.drop_out = 0.05
    board_with(emulated, {'link to the board': 'fail', 'link from the board': 'warn'},
               seconds=2.0)


def test_firmware_with_another_protocol_version_is_refused(emulated, monkeypatch):
    monkeypatch.setattr(motor_board_state, 'CONTRACT_VERSION', 2)
    found = board_with(emulated, {'board firmware': 'fail'})
    assert 'contract 1, this driver uses 2' in found['board firmware'].found


def test_a_difference_in_settings_of_the_computer_is_reported(emulated):
    found = board_with(emulated, {'board receives host': 'fail', 'board clock': 'fail'},
                       host_component=190)
    assert 'host_component' in found['board receives host'].remedy


def test_a_silent_or_foreign_board_ends_the_checks(emulated):
    found = board_with(emulated, {'motor board': 'fail'}, seconds=0.5, board_component=7)
    assert 'component 7' in found['motor board'].remedy
    emulated.faults.mute = True
    found = board(emulated.port, seconds=0.5)
    assert list(found) == [*ALL[:2], 'motor board']
    assert '0 bytes' in found['motor board'].found
    emulated.unplug()
    (port,) = board(emulated.port).values()
    assert port.level == 'fail' and 'no such port' in port.found


def test_without_pymavlink_the_extra_is_named(emulated, monkeypatch):
    for name in ('motor_board', 'motor_board_state'):
        monkeypatch.delitem(sys.modules, f'beetle_omni_ros.drivers.{name}')
    monkeypatch.setitem(sys.modules, 'pymavlink', None)
    monkeypatch.setitem(sys.modules, 'pymavlink.dialects.v20', None)
    found = board(emulated.port)
    assert levels(found) == {'motor board': 'fail'}
    assert "'beetle_omni_ros[hardware]'" in found['motor board'].remedy
