"""Lost turn counts: unambiguous angles, refusals, confirmation by the operator."""

from dataclasses import replace
from math import pi

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from servo_bench import arrived, bench, COUNT, JOINTS, running, until

from beetle_omni_ros.drivers.servo_link import ServoBusError
from beetle_omni_ros.drivers.servo_turns import candidates, nearest_turns, unambiguous_limit

TRAVEL = JOINTS.position_limit


def place(emulated, angles):
    """Move the servos to angles and switch their power off and on, which clears the turns."""
    emulated.set_state(angles, np.zeros(4), np.zeros(4))
    for index in range(4):
        emulated.servos[index].reboot(-1.0)


@given(st.floats(-TRAVEL, TRAVEL))
def test_the_true_angle_is_always_among_the_candidates(angle):
    reading = (angle + pi) % (2 * pi) - pi
    options = candidates(reading, TRAVEL)
    assert any(option == pytest.approx(angle, abs=1e-9) for option in options)
    assert all(abs(option) <= TRAVEL for option in options)
    assert (len(options) == 1) == (abs(reading) < unambiguous_limit(TRAVEL))


@given(st.floats(-4, 4), st.integers(-2, 2), st.floats(-3, 3))
def test_the_nearest_turn_is_found(angle, turns, apart):
    assert nearest_turns(angle - 2 * pi * turns, angle + apart) == turns


@pytest.mark.real_time
@pytest.mark.parametrize('angles', [[0, 0, 0, 0], [2.3, -2.3, 1.0, -1.0]])
def test_torque_comes_on_if_the_angle_is_unique(angles):
    with bench() as (bus, emulated):
        place(emulated, angles)
        bus.configure()
        bus.enable()
        assert bus.read().position == pytest.approx(angles, abs=COUNT)


@pytest.mark.real_time
def test_torque_is_refused_for_an_ambiguous_turn_with_the_remedy():
    with bench() as (bus, emulated):
        place(emulated, [0.0, 2.8, 0.0, 3.5])
        bus.configure()
        with pytest.raises(ServoBusError) as caught:
            bus.enable()
        text = str(caught.value)
        assert 'gimbal2 (id 2) stands at -3.48 or +2.80 rad' in text
        assert 'gimbal4 (id 4) stands at -2.78 or +3.50 rad' in text
        assert 'gimbal1' not in text and '+-2.32 rad' in text and 'confirm_tilts' in text
        assert not bus.enabled and not emulated.torque_enabled.any()


@pytest.mark.real_time
def test_confirmation_by_the_operator_resolves_the_turn():
    true = np.array([0.0, 2.8, 0.0, 3.5])
    with bench() as (bus, emulated):
        place(emulated, true)
        bus.configure()
        bus.parameters = replace(bus.parameters, confirm_tilts=True,
                                 confirmed_tilts=np.array([0.0, 3.0, 0.0, 3.0]))
        bus.enable()
        assert bus.read().position == pytest.approx(true, abs=COUNT)
        assert emulated.goals == pytest.approx(true, abs=COUNT)
        goal = np.array([0.0, 3.9, 0.0, -3.9])
        until(arrived(goal), bus, goal)
        assert np.allclose(emulated._motion.position, goal, atol=2 * COUNT)


@pytest.mark.real_time
def test_turning_the_joint_by_hand_resolves_the_turn():
    with bench() as (bus, emulated):
        place(emulated, [0.0, 0.0, 0.0, 3.5])
        bus.configure()
        with pytest.raises(ServoBusError):
            bus.enable()
        for angle in np.linspace(3.5, 1.0, 6):
            emulated.set_state([0.0, 0.0, 0.0, angle], np.zeros(4), np.zeros(4))
            bus.read()
        bus.enable()
        assert bus.read().position == pytest.approx([0, 0, 0, 1.0], abs=COUNT)
        assert emulated.goals == pytest.approx([0, 0, 0, 1.0], abs=COUNT)


@pytest.mark.real_time
def test_turns_are_kept_over_disable_while_the_servo_has_power():
    with running() as (bus, emulated):
        goal = np.array([3.9, -3.9, 0.0, 0.0])
        until(arrived(goal), bus, goal)
        bus.disable()
        # By hand, without readings, by more than half a turn.
        emulated.set_state([-0.5, 0.5, 0.0, 0.0], np.zeros(4), np.zeros(4))
        bus.configure()
        bus.enable()
        assert bus.read().position == pytest.approx([-0.5, 0.5, 0, 0], abs=COUNT)


@pytest.mark.real_time
def test_turns_are_ambiguous_after_a_restart_without_torque():
    with running() as (bus, emulated):
        goal = np.array([3.5, 0.0, 0.0, 0.0])
        until(arrived(goal), bus, goal)
        bus.disable()
        emulated.servos[0].reboot(-1.0)
        with pytest.raises(ServoBusError, match=r'gimbal1 .* stands at -2.7. or \+3.50 rad'):
            bus.enable()


@pytest.mark.real_time
def test_a_restart_in_flight_is_unwrapped_to_the_last_good_angle():
    with running() as (bus, emulated):
        goal = np.array([3.5, -3.5, 0.3, 0.0])
        until(arrived(goal), bus, goal)
        emulated.reboot(0)
        emulated.reboot(1)
        readings, _ = until(lambda readings, reports: all(
            one.torque and not one.recovering for one in reports)
            and emulated.torque_enabled.all() and readings.valid.all(), bus, goal)
        assert readings.position == pytest.approx(goal, abs=0.1)
        assert emulated.servos[0]['Present Position'] < 4096, 'its own count is another'
        # And goals have the same meaning as before.
        further = np.array([3.9, -2.0, 0.3, 0.0])
        until(arrived(further), bus, further)
        assert np.allclose(emulated._motion.position, further, atol=2 * COUNT)
        assert any('restarted' in line for line in bus.take_events())
