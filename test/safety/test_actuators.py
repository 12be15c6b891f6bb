"""Reactions of the supervisor to states of the bridges to servos and motor board."""

import pytest
from vehicle_rig import flown, TICK, VehicleRig


def report(rig, name, text):
    """Give a bridge state to the supervisor, and one step."""
    rig.supervisor.on_actuators(name, text, rig.now)
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
