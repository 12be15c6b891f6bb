"""The supervisor with a fault in flight or while landing: crashes, pauses, limits, sensors."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_rig import flown

from beetle_omni_ros.model import rotations


def test_an_impact_near_the_floor_stops_the_motors_for_good():
    rig = flown()
    rig.position = np.array([0.3, -0.2, 0.25])
    rig.run(0.05)
    rig.supervisor.inputs.on_imu(rig.now + 0.001, np.array([0, 0, 120.0]), np.zeros(3))
    rig.run(0.05)
    assert rig.supervisor.state == 'flying', 'a lone sample is a spike of the sensor'
    for after in (0.001, 0.006):
        rig.supervisor.inputs.on_imu(rig.now + after, np.array([0, 0, 120.0]), np.zeros(3))
    sent = rig.run(0.1)
    assert rig.supervisor.state == 'emergency_stop'
    assert rig.supervisor.mode == 'emergency_stop:crash'
    assert not sent[0].thrust.any()
    assert not rig.supervisor.arm(rig.now)


def test_a_pause_in_the_air_ends_in_fallback_and_on_the_floor_with_motors_off():
    rig = flown()
    rig.now += 0.4
    # the robot may lie on the floor, until MoCap shows where it is
    assert not any(command and command.thrust.any() for command in rig.run(0.015))
    assert any(command and command.thrust.any() for command in rig.run(0.05))
    assert 'supervisor_paused' in rig.supervisor.faults
    assert rig.supervisor.state in ('fallback', 'flying')
    severities = [event.severity for event in rig.supervisor.inputs.events if 'paus' in event.text
                  or 'not scheduled' in event.text]
    assert set(severities) == {'warning'}, 'the robot survived it'
    rig = flown()
    rig.now += 1.0
    rig.position = np.array([0.3, -0.2, 0.2])
    sent = rig.run(0.5)
    assert rig.supervisor.state in ('disarmed', 'emergency_stop')
    assert not any(command.thrust.any() for command in sent if command is not None)


@pytest.mark.parametrize('spoil', [
    lambda p: setattr(p, 'position', np.array([0.0, 0.0, 25.0])),
    lambda p: setattr(p, 'rate', np.array([20.0, 0.0, 0.0]))])
def test_limits_hold_while_landing(spoil):
    rig = flown()
    rig.supervisor.land(rig.now)
    rig.velocity = np.array([0.0, 0.0, -0.3])
    spoil(rig)
    rig.run(0.9)
    assert rig.supervisor.state == 'landing'
    rig.run(0.5)
    assert rig.supervisor.state == 'emergency_stop'


def test_silent_joints_that_act_beside_their_commands_stop_the_motors():
    rig = flown()
    rig.alive.discard('joints')
    rig.velocity = np.array([0.0, 0.0, -0.3])
    rig.run(1.0)
    assert rig.supervisor.mode == 'landing:joints_lost'
    follows = rig._specific_force
    rig._specific_force = lambda tilt: follows(tilt + [1.0, 1.0, -1.0, -1.0])
    rig.run(0.2)
    assert rig.supervisor.state == 'landing'
    rig.run(0.3)
    assert rig.supervisor.state == 'emergency_stop'


def test_landing_and_fallback_end_in_time(monkeypatch):
    monkeypatch.setattr('beetle_omni_ros.supervisor.supervisor.LANDING_LIMIT', 10.0)
    monkeypatch.setattr('beetle_omni_ros.supervisor.supervisor.FALLBACK_TIME', 3.0)
    rig = flown()
    rig.alive -= {'nmpc', 'rl'}
    rig.run(2.9)
    assert rig.supervisor.state == 'fallback'
    rig.run(0.3)
    assert rig.supervisor.state == 'landing'
    rig.velocity = np.array([0.0, 0.0, -0.3])
    rig.run(9.7)
    assert rig.supervisor.state == 'landing'
    rig.run(0.5)
    assert rig.supervisor.state == 'emergency_stop'


@pytest.mark.parametrize('wrong, fault', [('mocap', 'mocap_jumped'),
                                          ('estimate', 'estimator_wrong')])
def test_a_turn_of_the_markers_or_of_the_estimate_is_named_and_leads_to_a_landing(wrong, fault):
    rig = flown()
    attitude, turned = rig.quaternion, rotations.from_rpy(0, 0, np.pi / 2)
    if wrong == 'mocap':
        rig.quaternion = turned
    on_state = rig.supervisor.inputs.on_state
    rig.supervisor.inputs.on_state = lambda state, now: on_state(
        replace(state, quaternion=attitude if wrong == 'mocap' else turned), now)
    rig.run(2.0)
    assert fault in rig.supervisor.faults
    assert rig.supervisor.state == 'landing'
