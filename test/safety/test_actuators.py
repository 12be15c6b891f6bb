"""Reactions of the supervisor to states of the bridges to servos and motor board."""

from puppet import flown, Puppet, TICK
import pytest

from beetle_omni_ros.safety.actuators import Actuators


def report(puppet, name, text):
    """Give a bridge state to the supervisor, and one step."""
    assert puppet.supervisor.on_actuators(name, text, puppet.now)
    puppet.run(TICK)


def test_bridges_without_any_message_have_no_influence():
    puppet = flown()
    assert puppet.supervisor.actuators.why_not_arm == ''
    assert puppet.supervisor.actuators.diagnostics() == {}


@pytest.mark.parametrize('name', ['joint', 'rotor'])
@pytest.mark.parametrize('text', ['waiting: port is away', 'lost: restarted', 'something', ''])
def test_a_bridge_that_is_not_ready_prevents_arming_with_its_reason(name, text):
    puppet = Puppet()
    puppet.run(0.6)
    report(puppet, name, text)
    answer = puppet.supervisor.arm(puppet.now)
    assert not answer and f'{name}_bridge_node {text}' in answer.text
    assert puppet.supervisor.state == 'disarmed'
    report(puppet, name, 'ready')
    assert puppet.supervisor.arm(puppet.now)


def test_both_reasons_are_given_on_one_line():
    actuators = Actuators()
    actuators.tell('rotor', 'waiting: battery low')
    actuators.tell('joint', 'waiting: gimbal2\nstands at -3.48 or +2.80 rad')
    assert actuators.why_not_arm == ('joint_bridge_node waiting: gimbal2 stands at -3.48 or +2.80 '
                                     'rad; rotor_bridge_node waiting: battery low')


@pytest.mark.parametrize('text', ['lost: gimbal3 silent', 'waiting: deactivated'])
def test_lost_servos_in_flight_lead_to_a_landing_that_names_them(text):
    puppet = flown()
    report(puppet, 'joint', 'ready')
    assert puppet.supervisor.state == 'flying'
    report(puppet, 'joint', text)
    assert puppet.supervisor.state == 'landing'
    assert any(said.startswith(f'joint_bridge_node {text}: landing')
               for said in puppet.texts('error'))
    report(puppet, 'joint', 'ready')
    assert puppet.supervisor.state == 'landing'


@pytest.mark.parametrize('landing', [False, True])
def test_a_lost_motor_board_in_flight_stops_everything_until_disarmed(landing):
    puppet = flown()
    report(puppet, 'rotor', 'ready')
    if landing:
        assert puppet.supervisor.land(puppet.now)
        puppet.run(TICK)
    report(puppet, 'rotor', 'lost: restarted')
    assert puppet.supervisor.state == 'emergency_stop'
    assert not puppet.command.thrust.any()
    assert any('rotor_bridge_node lost: restarted' in said for said in puppet.texts('error'))
    report(puppet, 'rotor', 'ready')
    assert puppet.supervisor.state == 'emergency_stop'
    assert puppet.supervisor.disarm(puppet.now)


def test_a_silent_motor_board_leads_to_a_powered_landing():
    puppet = flown()
    report(puppet, 'rotor', 'silent: nothing heard of the board')
    assert puppet.supervisor.state == 'landing' and puppet.command.thrust.any()
    assert any('silent: nothing heard of the board: landing' in said
               for said in puppet.texts('error'))
    report(puppet, 'rotor', 'lost: restarted')
    assert puppet.supervisor.state == 'emergency_stop'


@pytest.mark.parametrize('name', ['joint', 'rotor'])
def test_a_bridge_lost_before_lift_off_stops_the_motors(name):
    puppet = Puppet()
    puppet.lifts = False
    puppet.run(0.6)
    assert puppet.supervisor.arm(puppet.now)
    puppet.run(0.1)
    report(puppet, name, 'lost: not armed: refused by the board: battery low')
    assert puppet.supervisor.state == 'disarmed'
    assert any('battery low' in said and 'still on the ground: motors off' in said
               for said in puppet.texts('error'))


def test_a_bridge_lost_while_disarmed_does_not_affect_the_next_flight():
    puppet = Puppet()
    puppet.run(0.6)
    report(puppet, 'rotor', 'lost: restarted')
    assert puppet.supervisor.state == 'disarmed' and not puppet.texts('error')
    assert puppet.supervisor.diagnostics()['rotor_bridge_node'] == 'lost: restarted'


def test_an_unknown_bridge_is_refused_and_reported():
    puppet = flown()
    assert not puppet.supervisor.on_actuators('wheel', 'lost: it', puppet.now)
    puppet.run(0.1)
    assert puppet.supervisor.state == 'flying'
    assert any("unknown bridge 'wheel'" in said for said in puppet.texts('warning'))
