"""Reactions of the supervisor to states of the bridges to servos and motor board."""

import numpy as np
import pytest
from vehicle_rig import flown, TICK, VehicleRig


def report(rig, name, text):
    """Give a bridge state to the supervisor, and one step."""
    rig.supervisor.inputs.on_actuators(name, text, rig.now)
    rig.run(TICK)


@pytest.mark.parametrize('name', ['joint', 'rotor'])
@pytest.mark.parametrize('text', ['waiting: port is away', 'something'])
def test_a_bridge_that_is_not_ready_prevents_arming_with_its_reason(name, text):
    rig = VehicleRig()
    rig.run(0.6)
    report(rig, name, text)
    answer = rig.supervisor.arm(rig.now)
    assert not answer and f'{name}_bridge_node {text}' in answer.text
    assert rig.supervisor.state == 'disarmed'
    report(rig, name, 'ready')
    assert rig.supervisor.arm(rig.now)


@pytest.mark.parametrize('name, text, state', [
    ('joint', 'lost: gimbal3 silent', 'landing'),
    ('rotor', 'silent: no message from the board', 'landing'),
    ('rotor', 'lost: restarted', 'emergency_stop')])
def test_a_lost_bridge_in_flight_leads_to_a_landing_or_stop_that_names_it(name, text, state):
    rig = flown()
    report(rig, name, 'ready')
    assert rig.supervisor.state == 'flying'
    report(rig, name, text)
    assert rig.supervisor.state == state and rig.command.thrust.any() == (state == 'landing')
    assert any(f'{name}_bridge_node {text}' in event for event in rig.texts('error'))
    report(rig, name, 'ready')
    assert rig.supervisor.state == state


@pytest.mark.parametrize('name', ['joint', 'rotor'])
def test_a_bridge_lost_before_lift_off_stops_the_motors(name):
    rig = VehicleRig()
    rig.lifts = False
    rig.run(0.6)
    assert rig.supervisor.arm(rig.now)
    rig.run(0.1)
    report(rig, name, 'lost: not armed: refused by the board: battery low')
    assert rig.supervisor.state == 'disarmed'
    assert any('battery low' in event and 'still on the ground: motors off' in event
               for event in rig.texts('error'))


def report_speeds(rig):
    """Report the rotors' speeds in each step; return the factors (4,) that a test may change."""
    publish, factors = rig._publish, np.ones(4)

    def with_speeds():
        publish()
        if factors.all():
            rig.supervisor.inputs.on_rotors(rig.now, factors * np.sqrt(rig.thrust))

    rig._publish = with_speeds
    return factors


@pytest.mark.parametrize('late', [False, True])
def test_no_rotor_is_isolated_while_commands_are_late(late):
    rig = flown()
    factors = report_speeds(rig)
    rig.run(2.0)
    rig.age['nmpc'] = 0.03 if late else 0.0
    rig.run(0.06)
    factors[0] = 0.5
    rig.run(0.2)
    assert ('rotor1_lost' in rig.supervisor.faults) is not late


@pytest.mark.parametrize('late', [False, True])
def test_no_joint_is_isolated_while_commands_are_late(late):
    rig = flown()
    on_joints = rig.supervisor.inputs.on_joints
    rig.age['nmpc'] = 0.03 if late else 0.0
    rig.supervisor.inputs.on_joints = lambda stamp, tilt, rate: on_joints(
        stamp, tilt + [0.4, 0.0, 0.0, 0.0], rate)
    rig.run(0.2)
    rig.supervisor.inputs.on_joints = on_joints
    rig.run(1.0)
    assert ('joint1_astray' in rig.supervisor.faults) is not late
    assert rig.supervisor.state == ('fallback' if late else 'landing')


def test_without_their_bridge_the_joints_count_as_stopped_where_they_were():
    rig = flown()
    report(rig, 'joint', 'ready')
    angles = rig.supervisor.inputs.tilt
    rig.alive.discard('joints')
    rig.velocity = np.array([0.3, 0.0, 0.0])
    rig.run(0.3)
    assert rig.supervisor.mode == 'landing:joint_bridge_lost'
    assert any(text.startswith('joint_bridge_node silent for') for text in rig.texts('error'))
    assert np.abs(rig.command.tilt - angles).max() > 0.01
    assert np.array_equal(rig.supervisor._seen.tilt, angles)


def test_a_rotor_bridge_that_is_silent_is_named_before_the_robot_reaches_the_floor():
    rig = flown()
    report(rig, 'rotor', 'ready')
    factors = report_speeds(rig)
    rig.run(1.0)
    assert not rig.supervisor.faults
    factors[:] = 0.0    # no report
    rig.run(0.25)
    assert list(rig.supervisor.faults) == ['rotor_bridge_silent']
    assert any('rotor_bridge_node silent for' in text for text in rig.texts('error'))
