"""The check of the servo bus finds each fault, with a remedy, and changes nothing."""

import numpy as np
import pytest

pytest.importorskip('dynamixel_sdk')
pytest.importorskip('pymavlink')

from check_helpers import levels, repeated, servos
from servo_bench import running

from beetle_omni_ros.drivers import device_checks as room
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

NAMES = [f'gimbal{k}' for k in (1, 2, 3, 4)]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(room, 'ROUNDS', 5)


def test_a_good_bus_passes_and_its_measurements_are_reported():
    with EmulatedServoBus() as emulated:
        found = servos(emulated.port)
    assert levels(found) == {}
    assert list(found) == ['servo port', 'servo bus', *NAMES]
    assert found['gimbal3'].values == pytest.approx({
        'id': 3, 'model': 1210, 'firmware': 52, 'baud_rate': 1_000_000, 'supply_V': 12.0,
        'temperature_C': 35.0, 'position_rad': 0.0})
    assert found['servo bus'].values['asked'] == 20


def test_the_check_writes_no_register():
    with EmulatedServoBus() as emulated:
        emulated.set_state(np.full(4, 0.5), np.zeros(4), np.zeros(4))
        emulated.faults.silent = {4}
        packets, handle = [], emulated.handle
        emulated.handle = lambda packet, *rest: packets.append(packet) or handle(packet, *rest)
        servos(emulated.port)
    assert packets and {instruction for _, instruction, _ in packets} == {1, 2}    # ping and read


def test_torque_that_was_on_before_stays_on_and_is_reported():
    with running() as (bus, emulated):
        bus.link.close()       # the driver has ended, and the guard is not used
        found = servos(emulated.port)
        assert emulated.torque_enabled.all()
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
def test_each_fault_is_found_and_named(name):
    break_it, bad, item, words = FAULTS[name]
    with EmulatedServoBus() as emulated:
        break_it(emulated)
        found = repeated(lambda: servos(emulated.port),
                         lambda found: levels(found) == bad)
    # A bad line may hide servos too.
    assert levels(found) == bad or name == 'line' and levels(found).items() > bad.items()
    text = found[item].found + found[item].remedy
    assert all(word in text for word in words), text
