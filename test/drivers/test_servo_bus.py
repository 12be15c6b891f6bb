"""The driver without faults: settings, angles and their turns, torque, refusals."""

from math import pi

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from servo_bench import arrived, bench, COUNT, JOINTS, read, running, until

from beetle_omni_ros.drivers import servo_xc330 as xc330
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_xc330 import ServoBusError
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import bind, load_yaml, ParameterError
from beetle_omni_ros.sim.emulated import servo_bus as table

GOAL = np.array([0.4, -1.2, 3.7, -3.9])
TRAVEL = JOINTS.position_limit
ZERO = np.zeros(4)


@pytest.mark.real_time
def test_configuring_writes_all_settings_and_eeprom_once(monkeypatch):
    with bench(position_p_gain=640, position_d_gain=300, current_limit=0.5) as (bus, emulated):
        for servo in emulated.servos:
            servo['Torque Enable'], servo['Drive Mode'] = 1, 5
        bus.configure()
        for servo in emulated.servos:
            assert not servo.torque
            assert servo['Operating Mode'] == 4     # extended position
            assert (servo['Return Delay Time'], servo['Drive Mode']) == (0, 0)
            # The mode resets the gains, so it was written first.
            assert (servo['Position P Gain'], servo['Position D Gain']) == (640, 300)
            assert servo['Current Limit'] == 500
        assert not emulated.refusals, 'nothing that the servo refuses was tried'
        written = []
        for servo in emulated.servos:
            monkeypatch.setattr(servo, 'write', lambda address, data, write=servo.write: (
                written.append(address), write(address, data))[1])
        bus.configure()
        assert min(written) >= table.EEPROM_END


@pytest.mark.real_time
def test_counts_and_tilts_convert_with_signs_and_zeros():
    signs, zeros = [1, -1, 1, -1], [2048, 2000, 2100, 2048]
    with running(signs=np.array(signs, float), zeros=np.array(zeros, float), servos={
            'signs': signs, 'zeros': zeros}) as (bus, emulated):
        readings, _ = until(arrived(GOAL), bus, GOAL)
        assert emulated.drive()[0] == pytest.approx(GOAL, abs=0.51 * COUNT)
        true = [servo.angle for servo in emulated.servos]
        assert np.allclose(readings.position, true, atol=COUNT)
        assert not emulated.refusals and bus.link.counts['corrupt'] == 0


@pytest.mark.real_time
def test_torque_comes_on_without_a_jump_and_goes_off_at_disable_and_close():
    with bench() as (bus, emulated):
        bus.configure()
        emulated.set_state([0.5, -1.0, 1.5, -2.0], ZERO, ZERO)
        for servo in emulated.servos:
            servo['Goal Position'] = 100
        bus.enable()
        assert all(emulated.drive()[1])
        assert emulated.drive()[0] == pytest.approx([0.5, -1.0, 1.5, -2.0], abs=COUNT)
        assert [servo['Bus Watchdog'] for servo in emulated.servos] == [5] * 4
        assert bus.disable()
        assert not any(emulated.drive()[1])
        assert not bus.write_goals(GOAL), 'no goals without torque'
        bus.enable()
        bus.close()
        assert not any(emulated.drive()[1])
        bus.close()


@pytest.mark.real_time
def test_goals_beyond_the_travel_are_clipped():
    with running() as (bus, emulated):
        assert bus.write_goals([9.0, -9.0, 0.0, 0.0])
        bus.read()  # answered after the goals
        assert emulated.drive()[0] == pytest.approx([TRAVEL, -TRAVEL, 0, 0], abs=COUNT)


@pytest.mark.parametrize(('change', 'text'), [
    ({'ids': [1, 2, 3, 3]}, 'ids must differ'), ({'signs': [1, 1, 1, 0]}, 'signs must be')])
def test_impossible_parameters_are_refused(change, text):
    shipped = load_yaml(share_path('params/servo_bus.yaml'))
    with pytest.raises(ParameterError, match=text):
        bind(ServoBusParameters, {**shipped, **change}, 'file')


@pytest.mark.parametrize('register', [
    value for value in vars(xc330).values() if isinstance(value, xc330.Register)], ids=str)
def test_registers_agree_with_the_table_of_the_emulated_servo(register):
    emulated = table.TABLE[register.name]
    assert (emulated.address, emulated.size, emulated.signed) == register[1:]
    value = -2 if register.signed else 2
    assert register.decoded(register.encoded(value)) == value


# --- turns ------------------------------------------------------------------------------------

def place(emulated, angles):
    """Move the servos to angles and switch their power off and on, which clears the turns."""
    emulated.set_state(angles, ZERO, ZERO)
    for index in range(4):
        emulated.servos[index].reboot(-1.0)


@given(st.floats(-TRAVEL, TRAVEL))
def test_the_true_angle_is_always_among_the_candidates(angle):
    reading = (angle + pi) % (2 * pi) - pi
    options = xc330.candidates(reading, TRAVEL)
    assert any(option == pytest.approx(angle, abs=1e-9) for option in options)
    assert all(abs(option) <= TRAVEL for option in options)
    assert (len(options) == 1) == (abs(reading) < xc330.unambiguous_limit(TRAVEL))


@pytest.mark.real_time
def test_an_ambiguous_turn_is_refused_until_the_joint_is_turned_by_hand():
    true = np.array([2.3, 2.8, -1.0, 3.5])
    with bench() as (bus, emulated):
        place(emulated, true)
        bus.configure()
        with pytest.raises(ServoBusError) as caught:
            bus.enable()
        text = str(caught.value)
        assert 'gimbal2 (id 2) stands at -3.48 or +2.80 rad' in text
        assert 'gimbal4 (id 4) stands at -2.78 or +3.50 rad' in text
        assert 'gimbal1' not in text and '+-2.32 rad' in text
        assert not bus.enabled and not any(emulated.drive()[1])
        true = np.array([2.3, 2.2, -1.0, 2.2])      # by hand; its second solution is gone
        emulated.set_state(true, ZERO, ZERO)
        bus.enable()
        assert read(bus).position == pytest.approx(true, abs=COUNT)
        assert emulated.drive()[0] == pytest.approx(true, abs=COUNT)
        goal = np.array([0.0, 3.9, 0.0, -3.9])
        until(arrived(goal), bus, goal)
        assert np.allclose([servo.angle for servo in emulated.servos], goal, atol=2 * COUNT)


@pytest.mark.real_time
def test_turns_are_kept_over_disable_while_the_servo_has_power_and_lost_with_it():
    with running() as (bus, emulated):
        goal = np.array([3.9, -3.9, 0.0, 0.0])
        until(arrived(goal), bus, goal)
        bus.disable()
        # By hand, without readings, by more than half a turn.
        emulated.set_state([-0.5, 3.5, 0.0, 0.0], ZERO, ZERO)
        bus.configure()
        bus.enable()
        assert read(bus).position == pytest.approx([-0.5, 3.5, 0, 0], abs=COUNT)
        bus.disable()
        emulated.servos[1].reboot(-1.0)
        with pytest.raises(ServoBusError, match=r'gimbal2 .* stands at -2.7. or \+3.50 rad'):
            bus.enable()
