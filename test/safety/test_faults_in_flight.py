"""The supervisor with a fault in flight or while landing: crashes, pauses, limits, sensors."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_rig import flown, TICK

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ALL_HEALTHY
from beetle_omni_ros.safety.inputs import MOCAP_TIMEOUT
from beetle_omni_ros.safety.landing import FLARE_HEIGHT, SETTLING_TIME
from beetle_omni_ros.safety.way import inclination


def test_an_impact_near_the_floor_stops_the_motors_for_good():
    rig = flown()
    rig.position = np.array([0.3, -0.2, 0.25])
    rig.run(0.05)
    rig.supervisor.on_imu(rig.now + 0.001, np.array([0, 0, 120.0]), np.zeros(3))
    rig.run(0.05)
    assert rig.supervisor.state == 'flying', 'a lone sample is a spike of the sensor'
    for after in (0.001, 0.006):
        rig.supervisor.on_imu(rig.now + after, np.array([0, 0, 120.0]), np.zeros(3))
    sent = rig.run(0.1)
    assert rig.supervisor.state == 'emergency_stop'
    assert rig.supervisor.reported_state == 'emergency_stop:crash'
    assert not sent[0].thrust.any()
    assert not rig.supervisor.arm(rig.now)


def test_without_mocap_an_inverted_robot_sinks_while_it_turns_and_is_level_for_the_flare():
    rig = flown()
    rig.position, rig.status = np.array([0.3, -0.2, 2.0]), 'dead_reckoning'
    rig.quaternion = rotations.from_rpy(np.pi, 0.0, 0.0)
    rig.alive.discard('mocap')
    rig.run(MOCAP_TIMEOUT + 0.1)
    rig.supervisor.land(rig.now)
    rig.run(SETTLING_TIME + 2 * TICK)
    ramp = rig.supervisor._landing._ramp
    times = rig.now + np.arange(0.0, 6.0, 0.02)
    height = np.array([ramp.at(time).position[2] for time in times])
    tilted = np.array([inclination(ramp.at(time).quaternion) for time in times])
    flare = ramp.at(ramp.stamp + ramp.end).position[2]
    assert flare == pytest.approx(0.16 + FLARE_HEIGHT, abs=0.05)
    assert tilted[height < 1.9].max() > 1.0         # sinks before it is level
    assert tilted[height < flare + 0.02].max() < 0.3


@pytest.mark.parametrize(('speed', 'leaps'), [(0.0, True), (1.0, False)])
def test_with_a_weak_pack_an_inverted_robot_at_rest_leaps_before_it_turns(speed, leaps):
    rig = flown()
    rig.position, rig.velocity = np.array([0.3, -0.2, 1.5]), np.array([speed, 0.0, 0.0])
    rig.quaternion = rotations.from_rpy(np.pi, 0.0, 0.0)
    rig.run(0.2)
    rig.supervisor.watch.health = replace(ALL_HEALTHY, thrust_limit=8.8)
    rig.run(TICK)
    way = rig.supervisor.target_override
    turned = np.array([rotations.geodesic_angle(rig.quaternion, q) for q in way.quaternions])
    first = int(np.argmax(turned > 0.1))
    before = max(first - 1, 0)      # without a leap, the turn is asked at once
    rise, climb = way.positions[before, 2] - 1.5, way.velocities[before, 2]
    assert (rise > 0.2 and climb > 0.5) if leaps else (abs(rise) < 1e-6 and first == 0)
    assert way.positions[:, 2].max() < 2.3
    assert np.abs(way.angular_velocities).max() < 10    # no sample in the step of the attitude


def test_a_pause_in_the_air_ends_in_fallback_and_on_the_floor_with_motors_off():
    rig = flown()
    rig.now += 0.4
    rig.run(0.02)
    assert 'supervisor_paused' in rig.supervisor.faults
    assert rig.supervisor.state in ('fallback', 'flying')
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


def test_landing_and_fallback_end_in_time(monkeypatch):
    monkeypatch.setattr('beetle_omni_ros.safety.supervisor.LANDING_LIMIT', 10.0)
    monkeypatch.setattr('beetle_omni_ros.safety.supervisor.FALLBACK_TIME', 3.0)
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


@pytest.mark.parametrize('wrong, fault', [('mocap', 'mocap_flipped'),
                                          ('estimate', 'estimator_wrong')])
def test_a_turn_of_the_markers_or_of_the_estimate_is_named_and_leads_to_a_landing(wrong, fault):
    rig = flown()
    attitude, turned = rig.quaternion, rotations.from_rpy(0, 0, np.pi / 2)
    if wrong == 'mocap':
        rig.quaternion = turned
    on_state = rig.supervisor.on_state
    rig.supervisor.on_state = lambda state, status: on_state(
        replace(state, quaternion=attitude if wrong == 'mocap' else turned), status)
    rig.run(2.0)
    assert fault in rig.supervisor.faults
    assert rig.supervisor.state == 'landing'
