"""The check of the motor board finds each fault, with a remedy, and arms nothing."""


import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('dynamixel_sdk')

from check_helpers import board, levels, QUICK, repeated

from beetle_omni_ros.drivers import motor_board
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard

pytestmark = pytest.mark.real_time

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


def put(**faults):
    return lambda emulated: [setattr(emulated.faults, *item) for item in faults.items()]


@pytest.mark.parametrize(('break_it', 'changes', 'bad', 'words'), [
    (volts(20.0), {}, {'battery': 'fail', 'board ready to arm': 'fail'}, '3.33 V a cell of 6'),
    (volts(21.6), {}, {'battery': 'warn'}, '3.60 V a cell of 6'),
    (put(failed_escs=(2,)), {}, {'ESC of rotor 2': 'fail', 'board ready to arm': 'fail'},
     'offline'),
    (put(corrupt_in=0.5, drop_out=0.05), {'seconds': 2.0},
     {'link to the board': 'fail', 'link from the board': 'warn'}, ''),
    (put(drop_in=1.0), {}, {'board receives host': 'fail', 'board clock': 'fail'}, 'TX wire')])
def test_each_fault_is_found_and_named(emulated, break_it, changes, bad, words):
    break_it(emulated)
    found = board_with(emulated, bad, **changes)[next(iter(bad))]
    assert words in found.found + found.remedy


def test_a_silent_or_foreign_board_ends_the_checks(emulated, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(motor_board, 'BOARD', (1, 7))
        found = board_with(emulated, {'motor board': 'fail'}, seconds=0.5)
    assert 'another device' in found['motor board'].remedy
    emulated.faults.drop_out = 1.0
    found = board(emulated.port, seconds=0.5)
    assert list(found) == ['board port', 'motor board']
    assert '0 bytes' in found['motor board'].found
    emulated.unplug()
    (port,) = board(emulated.port).values()
    assert port.level == 'fail' and 'no such port' in port.found
