"""The driver without faults: settings, angles, torque, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from servo_bench import arrived, bench, COUNT, JOINTS, running, SHIPPED, tick, until

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.servo_link import ServoBusError
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_setup import scan
from beetle_omni_ros.robot.schema import bind, load_yaml, ParameterError
from beetle_omni_ros.sim.emulated import servo_table as table

GOAL = np.array([0.4, -1.2, 3.7, -3.9])


@pytest.mark.real_time
def test_configuring_sets_mode_before_gains_and_leaves_torque_off():
    gains = replace(SHIPPED.gains, proportional=640, derivative=300, feedforward_velocity=12)
    with bench(gains=gains, current_limit=0.5) as (bus, emulated):
        for servo in emulated.servos:
            servo['Torque Enable'], servo['Drive Mode'] = 1, 5
        bus.configure()
        for servo in emulated.servos:
            assert not servo.torque
            assert servo['Operating Mode'] == table.EXTENDED_MODE
            assert (servo['Return Delay Time'], servo['Drive Mode']) == (0, 0)
            assert (servo['Position P Gain'], servo['Position D Gain']) == (640, 300)
            assert (servo['Feedforward 1st Gain'], servo['Current Limit']) == (12, 500)
        assert not emulated.network.refused, 'nothing that the servo refuses was tried'


@pytest.mark.real_time
def test_configuring_again_writes_no_eeprom(monkeypatch):
    with bench() as (bus, emulated):
        bus.configure()
        written = []
        for servo in emulated.servos:
            apply = servo._apply
            monkeypatch.setattr(servo, '_apply', lambda name, value, apply=apply: (
                written.append(name), apply(name, value)))
        bus.configure()
        assert written
        assert not [name for name in written if table.BY_NAME[name].address < table.EEPROM_END]


@pytest.mark.real_time
def test_current_based_mode_caps_the_torque():
    with bench(mode='current_based_position', current_limit=0.3) as (bus, emulated):
        bus.configure()
        for servo in emulated.servos:
            assert servo['Operating Mode'] == table.CURRENT_POSITION_MODE
            assert servo['Goal Current'] == 300


@pytest.mark.real_time
@pytest.mark.parametrize(('signs', 'zeros'), [
    ([1, 1, 1, 1], [2048, 2048, 2048, 2048]), ([1, -1, 1, -1], [2048, 2000, 2100, 2048]),
    ([-1, -1, -1, -1], [1800, 2500, 2047, 2049])])
def test_counts_and_tilts_convert_with_signs_and_zeros(signs, zeros):
    with running(signs=np.array(signs, float), zeros=np.array(zeros, float),
                 servos={'signs': signs, 'zeros': zeros}) as (bus, emulated):
        readings, _ = until(arrived(GOAL), bus, GOAL)
        assert emulated.goals == pytest.approx(GOAL, abs=0.51 * COUNT)
        assert np.allclose(readings.position, emulated._motion.position, atol=COUNT)
        assert not emulated.network.refused


@pytest.mark.real_time
def test_velocity_current_and_effort_have_the_tilts_sign():
    with bench(signs=np.array([1.0, -1.0, 1.0, -1.0]),
               servos={'signs': [1, -1, 1, -1], 'motion': None}) as (bus, emulated):
        bus.configure()
        velocity, effort = np.array([2.0, 3.0, -4.0, -5.0]), np.array([0.1, 0.2, -0.3, -0.4])
        emulated.set_state(np.zeros(4), velocity, effort)
        readings = bus.read()
        assert readings.velocity == pytest.approx(velocity, abs=registers.VELOCITY_UNIT)
        assert readings.effort == pytest.approx(effort, abs=0.002)
        assert readings.current == pytest.approx(effort / 0.671, abs=0.002)


@pytest.mark.real_time
def test_torque_comes_on_without_a_jump_for_any_previous_goal():
    with bench() as (bus, emulated):
        bus.configure()
        emulated.set_state([0.5, -1.0, 1.5, -2.0], np.zeros(4), np.zeros(4))
        for servo in emulated.servos:
            servo['Goal Position'] = 100
        bus.enable()
        assert emulated.torque_enabled.all()
        assert emulated.goals == pytest.approx([0.5, -1.0, 1.5, -2.0], abs=COUNT)


@pytest.mark.real_time
def test_torque_is_off_after_disable_and_after_close():
    with running() as (bus, emulated):
        assert emulated.torque_enabled.all()
        assert bus.disable()
        assert not emulated.torque_enabled.any()
        assert not bus.write_goals(GOAL), 'no goals without torque'
        bus.enable()
        bus.close()
        assert not emulated.torque_enabled.any()
        bus.close()


@pytest.mark.real_time
def test_the_watchdog_runs_while_torque_is_on():
    with running() as (bus, emulated):
        assert [servo['Bus Watchdog'] for servo in emulated.servos] == [5] * 4


@pytest.mark.real_time
def test_goals_beyond_the_travel_are_clipped_and_nan_is_refused():
    with running() as (bus, emulated):
        assert bus.write_goals([9.0, -9.0, 0.0, 0.0])
        bus.read()  # answered after the goals
        limit = JOINTS.position_limit
        assert emulated.goals == pytest.approx([limit, -limit, 0, 0], abs=COUNT)
        before = emulated.goals
        for nonsense in ([np.nan, 0, 0, 0], [np.inf, 0, 0, 0], [0, 0, 0], [[0, 0, 0, 0]]):
            assert not bus.write_goals(nonsense)
        bus.read()
        assert emulated.goals == pytest.approx(before)
        assert (bus.clipped, bus.rejected) == (1, 4)


@pytest.mark.real_time
def test_old_firmware_is_read_with_plain_sync_read():
    with running(servos={'firmware': 45}) as (bus, emulated):
        until(arrived(GOAL), bus, GOAL)
        assert not emulated.network.refused
        assert bus.statistics.corrupt == 0


@pytest.mark.real_time
def test_health_contains_voltage_temperature_and_torque():
    with running() as (bus, emulated):
        emulated.faults.supply_voltage = 11.1
        _, reports = until(lambda _, reports: all(
            one.voltage == pytest.approx(11.1) and one.temperature == 35 for one in reports),
            bus, GOAL)
        assert [one.name for one in reports] == ['gimbal1', 'gimbal2', 'gimbal3', 'gimbal4']
        assert all(one.torque and one.responding and not one.message for one in reports)


@pytest.mark.real_time
def test_checking_changes_nothing_and_names_the_defects():
    with bench(servos={'identifiers': (1, 2, 3, 4)}) as (bus, emulated):
        emulated.servos[0]['Model Number'] = 1200
        emulated.faults.silent = {2}
        emulated.servos[2].trip(table.OVERLOAD)
        before = [bytes(servo._memory[:120]) for servo in emulated.servos]
        first, second, third, fourth = bus.check()
        assert 'model 1200, expected 1210' in first.problem
        assert 'does not answer' in second.problem and 'power' in second.remedy
        assert third.problem == 'overload' and 'reboot' in third.remedy
        assert fourth.ok and (fourth.firmware, fourth.baud_rate) == (52, 1_000_000)
        assert [bytes(servo._memory[:120]) for servo in emulated.servos] == before


@pytest.mark.real_time
def test_configuring_an_incomplete_bus_fails_in_one_line_for_all():
    with bench() as (bus, emulated):
        emulated.faults.silent = {2, 4}
        with pytest.raises(ServoBusError) as caught:
            bus.configure()
        text = str(caught.value)
        assert '\n' not in text and emulated.port in text
        assert 'gimbal2 (id 2)' in text and 'gimbal4 (id 4)' in text and 'gimbal1' not in text


@pytest.mark.real_time
@pytest.mark.parametrize('baud_rate', [9600, 57600, 3_000_000])
def test_scanning_finds_servos_at_another_baud_rate(baud_rate):
    with bench(servos={'baud_rate': baud_rate, 'timing': True}) as (bus, emulated):
        assert not any(finding.ok for finding in bus.check())
        bus.close()
        assert scan(bus.parameters) == [(baud_rate, name, 1210) for name in (1, 2, 3, 4)]


def test_a_port_is_refused_in_one_line(tmp_path):
    bus = ServoBus(replace(SHIPPED, port=str(tmp_path / 'nothing')), JOINTS)
    with pytest.raises(ServoBusError, match='nothing: no such port; check plug'):
        bus.open()
    readings, reports = tick(bus, GOAL)
    assert not readings.valid.any() and len(reports) == 4
    bus.close()


@pytest.mark.real_time
def test_a_port_in_use_is_refused():
    with bench() as (bus, emulated):
        with pytest.raises(ServoBusError, match='in use by another process'):
            ServoBus(bus.parameters, JOINTS).open()


@pytest.mark.parametrize(('change', 'text'), [
    ({'ids': [1, 2, 3, 3]}, 'ids must differ'), ({'signs': [1, 1, 1, 0]}, 'signs must be'),
    ({'zeros': [2048, 2048, 2048, 0.5]}, 'zeros must be whole'),
    ({'baud_rate': 123456}, 'none of the servos'), ({'mode': 'position'}, 'expected one of')])
def test_impossible_parameters_are_refused(change, text):
    from beetle_omni_ros.robot.resources import share_path
    shipped = load_yaml(share_path('params/servo_bus.yaml'))
    with pytest.raises(ParameterError, match=text):
        bind(ServoBusParameters, {**shipped, **change}, 'file')


def test_registers_agree_with_the_table_of_the_emulated_servo():
    assert {one.name: (one.address, one.size, one.signed) for one in registers.ALL} \
        == {one.name: (one.address, one.size, one.signed) for one in table.REGISTERS}


@pytest.mark.parametrize('value', [0, 1, -1, 4630, -534, -2**31, 2**31 - 1])
def test_signed_registers_round_trip(value):
    register = registers.GOAL_POSITION
    assert register.decoded(register.encoded(value)) == value
