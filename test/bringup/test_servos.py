"""The check of the servo bus finds each fault, with a remedy, and changes nothing."""

import sys

import numpy as np
import pytest

pytest.importorskip('dynamixel_sdk')
pytest.importorskip('pymavlink')

from check_helpers import levels, repeated, servos
from servo_bench import JOINTS, running

from beetle_omni_ros.bringup import servos as room
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

NAMES = [f'gimbal{k}' for k in (1, 2, 3, 4)]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Use few reads and few IDs."""
    monkeypatch.setattr(room, 'ROUNDS', 5)
    monkeypatch.setattr(room, 'OTHER_IDS', (1, 7))


def test_a_good_bus_passes_and_its_measurements_are_reported():
    with EmulatedServoBus(motion=JOINTS) as emulated:
        found = servos(emulated.port)
    assert levels(found) == {}
    assert list(found) == ['servo port', 'servo port latency timer', 'servo bus', *NAMES]
    assert found['gimbal3'].values == pytest.approx({
        'id': 3, 'model': 1210, 'firmware': 52, 'baud_rate': 1_000_000, 'supply_V': 12.0,
        'temperature_C': 35.0, 'position_rad': 0.0})
    assert found['servo bus'].values['asked'] == 20


def test_the_check_writes_no_register():
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.set_state(np.full(4, 0.5), np.zeros(4), np.zeros(4))
        emulated.faults.silent = {4}
        network, packets = emulated.network, []
        handle = network.handle
        network.handle = lambda packet, *rest: packets.append(packet) or handle(packet, *rest)
        servos(emulated.port)
    assert packets and {packet.instruction for packet in packets} == {1, 2}    # ping and read


def test_torque_that_was_on_before_stays_on_and_is_reported():
    with running() as (bus, emulated):
        bus.link.close()       # the driver has ended, and the guard is not used
        found = servos(emulated.port)
        assert emulated.torque_enabled.all()
    assert levels(found) == {f'{name} torque': 'warn' for name in NAMES}


def test_a_servo_at_another_baud_rate_is_found():
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.servos[1]['Baud Rate'] = 1
        found = servos(emulated.port)
    assert levels(found) == {'gimbal2': 'fail'}
    assert 'does not answer' in found['gimbal2'].found
    assert 'id 2 answers at 57600 bit/s' in found['gimbal2'].remedy


def test_a_servo_with_another_id_is_found():
    with EmulatedServoBus((1, 2, 7, 4), motion=JOINTS) as emulated:
        found = servos(emulated.port)
    assert levels(found) == {'gimbal3': 'fail'}
    assert 'id 7 at 1000000 bit/s' in found['gimbal3'].remedy


def test_a_missing_servo_and_an_empty_bus_are_reported():
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.faults.silent = {4}
        found = servos(emulated.port)
        assert levels(found) == {'gimbal4': 'fail'}
        assert 'connector' in found['gimbal4'].remedy
        emulated.faults.silent = {1, 2, 3, 4}
        found = servos(emulated.port)
    assert list(found)[2:] == ['servo bus'] and levels(found) == {'servo bus': 'fail'}
    assert 'supply' in found['servo bus'].remedy


def test_old_firmware_and_another_model_are_reported():
    with EmulatedServoBus(motion=JOINTS, firmware=44) as emulated:
        emulated.servos[0]['Model Number'] = 1060
        found = servos(emulated.port)
    assert levels(found) == {'gimbal1': 'fail'} | {f'{name} firmware': 'warn' for name in NAMES}
    assert 'model 1060' in found['gimbal1'].found


@pytest.mark.parametrize(('volts', 'level'), [(6.0, 'fail'), (9.0, 'warn'), (13.5, 'fail')])
def test_a_wrong_supply_voltage_is_reported(volts, level):
    bad = {f'{name} supply': level for name in NAMES}
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.faults.supply_voltage = volts
        found = repeated(lambda: servos(emulated.port), lambda found: levels(found) == bad)
    assert levels(found) == bad


def test_a_servo_that_has_shut_down_is_reported():
    with running(reboot_after_overload=False) as (bus, emulated):
        bus.link.close()
        emulated.servos[2].trip(0x20)
        found = servos(emulated.port)
    assert found['gimbal3'].level == 'fail' and 'overload' in found['gimbal3'].found
    assert 'reboot' in found['gimbal3'].remedy
    assert 'gimbal3 torque' not in found


def test_a_hot_servo_is_reported():
    bad = {'gimbal4': 'fail', 'gimbal4 temperature': 'warn'}
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.servos[3]['Temperature Limit'] = 50    # also at 60
        emulated.faults.overheated = {4}
        found = repeated(lambda: servos(emulated.port), lambda found: levels(found) == bad)
    assert levels(found) == bad


def test_an_ambiguous_turn_is_reported_unless_confirmed():
    angles = np.array([0.0, 2.8, 0.0, -1.0])
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.set_state(angles, np.zeros(4), np.zeros(4))
        found = servos(emulated.port)
        assert levels(found) == {'gimbal2 turn': 'fail'}
        assert '-3.48 or +2.80 rad' in found['gimbal2 turn'].found
        assert '2.32 rad' in found['gimbal2 turn'].remedy
        found = servos(emulated.port, confirm_tilts=True, confirmed_tilts=[0, -3, 0, 0])
    assert levels(found)['gimbal2 turn'] == 'warn'
    assert '-3.48 rad' in found['gimbal2 turn'].found


def test_corrupted_answers_are_counted():
    with EmulatedServoBus(motion=JOINTS) as emulated:
        emulated.faults.bad_crc = 0.4
        found = servos(emulated.port)
    assert found['servo bus'].level == 'fail'
    assert found['servo bus'].values['missing'] > 2


def test_a_missing_port_ends_the_checks():
    (finding,) = servos('/dev/no_servos').values()
    assert finding.item == 'servo port' and finding.level == 'fail'


def test_without_the_sdk_the_extra_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, 'beetle_omni_ros.drivers.servo_link')
    with EmulatedServoBus(motion=JOINTS) as emulated:
        monkeypatch.setitem(sys.modules, 'dynamixel_sdk', None)
        found = servos(emulated.port)
    assert levels(found) == {'servo bus': 'fail'}
    assert "'beetle_omni_ros[hardware]'" in found['servo bus'].remedy
