"""Each transition of the state machine, with a kinematic vehicle."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_rig import flown, PARAMETERS, ROBOT, TICK, VehicleRig

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.model import rotations
from beetle_omni_ros.supervisor.commands import RETURN_AFTER, TIMEOUT
from beetle_omni_ros.supervisor.inputs import ESTIMATE_TIMEOUT, JOINT_TIMEOUT, LOST_TIME, LOW_TIME
from beetle_omni_ros.supervisor.landing import TURN_HEIGHT
from beetle_omni_ros.supervisor.supervisor import STOP_TIME
from beetle_omni_ros.supervisor.way import inclination


@pytest.mark.parametrize('spoil, text', [
    (lambda p: p.alive.discard('estimate'), 'ekf_node silent since the start'),
    (lambda p: p.alive.discard('mocap'), 'no fresh pose (MoCap silent since the start)'),
    (lambda p: p.alive.discard('joints'), 'joint_bridge_node silent since the start'),
    (lambda p: setattr(p, 'quaternion', rotations.from_rpy(1.0, 0, 0)), 'inclined by 57 deg'),
    (lambda p: setattr(p, 'velocity', np.array([0.5, 0, 0])), 'moving at 0.50 m/s'),
    (lambda p: setattr(p, 'rate', np.array([0, 0, 1.0])), 'turning at 1.00 rad/s'),
    (lambda p: setattr(p, 'position', np.array([30.0, 0, 0])), 'outside the fence'),
    (lambda p: setattr(p, 'voltage', 20.0), 'battery at 20.0 V')])
def test_arming_is_refused_with_the_reason(spoil, text):
    rig = VehicleRig()
    spoil(rig)
    rig.run(0.3)
    answer = rig.supervisor.arm(rig.now)
    assert not answer and text in answer.text
    assert rig.supervisor.state == 'disarmed' and set(rig.run(0.1)) == {None}
    assert any(text in event for event in rig.texts('warning'))


def test_silent_controller_falls_back_to_hover_without_a_jump_and_gets_control_back():
    rig = flown()
    before = rig.command
    rig.alive.discard('nmpc')
    rig.run(TIMEOUT - TICK)
    assert rig.supervisor.state == 'flying'
    rig.run(TICK)
    assert rig.supervisor.state == 'fallback' and rig.supervisor.source == 'hover'
    assert any(text.startswith('nmpc_node silent for 50 ms') and 'fallback' in text
               for text in rig.texts('error'))
    assert np.abs(rig.command.tilt - before.tilt).max() < 0.2
    assert np.abs(rig.command.thrust - before.thrust).max() < 7
    rig.alive.add('nmpc')
    rig.run(RETURN_AFTER - 2 * TICK)
    assert rig.supervisor.state == 'fallback'
    rig.run(4 * TICK)
    assert rig.supervisor.state == 'flying' and rig.supervisor.source == 'nmpc'


@pytest.mark.parametrize('begin', [lambda rig: rig.alive.discard('nmpc'),
                                   lambda rig: rig.supervisor.land(rig.now)])
def test_fallback_and_landing_stop_a_turn_before_they_aim_at_a_pose(begin, monkeypatch):
    rig, seen, step = flown(), [], HoverController.step
    monkeypatch.setattr(HoverController, 'step', lambda own, state, target: seen.append(
        target.at(state.stamp)) or step(own, state, target))
    rig.rate, rig.velocity = np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.0, 0.0])
    rig.run(TICK)
    begin(rig)
    rig.run(TIMEOUT + TICK)
    assert np.array_equal(seen[-1].velocity, rig.velocity) and not seen[-1].angular_velocity.any()
    rig.rate = np.zeros(3)
    rig.run(3 * TICK)
    assert not seen[-1].velocity[:2].any()      # to rest, ahead
    assert 0.1 < seen[-1].position[0] - rig.position[0] < 1.0


@pytest.mark.parametrize('begin', [
    lambda rig: rig.supervisor.land(rig.now),
    lambda rig: rig.run(TIMEOUT - TICK)])     # silent
def test_fallback_and_landing_start_from_the_joints_and_not_from_a_far_target(begin):
    rig = flown()
    joints, publish = rig.command.tilt, rig._publish

    def late():     # the joints have not moved yet
        rig.command = replace(rig.command, tilt=joints)
        publish()

    rig._publish = late
    rig.alive.discard('nmpc')
    for far in (2.9, 3.0):
        rig.supervisor.inputs.on_command(
            'nmpc', Command(rig.now + TICK, joints + far, rig.command.thrust), rig.now)
        rig.run(TICK)
    assert np.abs(rig.command.tilt - joints).min() > 2.5
    begin(rig)
    rig.run(TICK)
    assert rig.supervisor.source == 'hover'
    assert np.abs(rig.command.tilt - joints).max() < 0.6


@pytest.mark.parametrize('late, text', [('nmpc', 'nmpc_node late: median age 30 ms'),
                                        ('estimate', 'ekf_node late: median age 30 ms')])
def test_late_commands_or_estimates_prevent_arming_with_the_reason(late, text):
    rig = VehicleRig()
    rig.age[late] = 0.03
    rig.run(0.6)
    answer = rig.supervisor.arm(rig.now)
    assert not answer and text in answer.text
    rig.age[late] = 0.0
    rig.run(0.6)
    assert rig.supervisor.arm(rig.now)


def test_commands_that_stay_late_fall_back_with_the_reason_until_they_are_punctual_again():
    rig = flown()
    rig.age['nmpc'] = 0.03
    rig.run(0.1)
    assert rig.supervisor.state == 'flying'
    rig.run(0.2)
    assert rig.supervisor.mode == 'fallback:commands_late'
    assert any('nmpc_node late: median age 30 ms' in text for text in rig.texts('error'))
    rig.run(2.0)
    assert rig.supervisor.state == 'fallback'
    assert 'late' in rig.supervisor.inputs.streams['nmpc'].complaint
    rig.age['nmpc'] = 0.0
    rig.run(RETURN_AFTER)
    assert rig.supervisor.state == 'fallback'
    rig.run(0.3)
    assert rig.supervisor.mode == 'flying:nmpc'


def test_late_estimates_are_named_although_the_commands_that_answer_them_are_late_too():
    rig = flown()
    rig.age = dict.fromkeys(rig.age, 0.03)
    rig.run(0.3)
    assert rig.supervisor.mode == 'fallback:estimates_late'


def test_single_late_commands_have_no_effect():
    rig = flown()
    for _ in range(100):
        rig.age['nmpc'] = 0.03
        rig.run(TICK)
        rig.age['nmpc'] = 0.0
        rig.run(2 * TICK)
    assert rig.supervisor.state == 'flying' and not rig.supervisor.faults


def test_selecting_in_flight_needs_a_good_controller():
    rig = VehicleRig()
    rig.alive.discard('rl')
    rig.fly()
    answer = rig.supervisor.select('rl')
    assert not answer and 'rl_node silent since the start; nmpc stays selected' in answer.text
    assert rig.supervisor.active == 'nmpc'
    rig.alive.add('rl')
    rig.run(0.2)
    assert 'good for only' in rig.supervisor.select('rl').text
    rig.run(0.4)
    assert rig.supervisor.select('rl')
    rig.run(TICK)
    assert rig.supervisor.source == 'rl' and rig.supervisor.state == 'flying'
    unknown = rig.supervisor.select('pid')
    assert not unknown and "unknown controller 'pid'" in unknown.text


def test_emergency_stop_is_latched_until_disarmed():
    rig = flown()
    assert rig.supervisor.emergency_stop(rig.now)
    sent = rig.run(1.0)
    stop_ticks = round(STOP_TIME / TICK)
    assert all(not command.thrust.any() for command in sent[:stop_ticks])
    assert set(sent[stop_ticks + 1:]) == {None}
    assert not rig.supervisor.arm(rig.now) and not rig.supervisor.land(rig.now)
    assert rig.supervisor.state == 'emergency_stop'
    assert rig.supervisor.disarm(rig.now) and rig.supervisor.state == 'disarmed'
    rig.position = np.array([0, 0, 0.16])
    assert rig.supervisor.arm(rig.now)


def test_joint_that_does_not_follow_stops_the_takeoff_before_the_rotors_start():
    rig = VehicleRig()
    stuck = np.array([0.0, 0.0, 1.5, 0.0])
    publish = rig._publish

    def with_stuck_joint():
        publish()
        rig.supervisor.inputs.tilt = stuck

    rig._publish = with_stuck_joint
    rig.run(0.6)
    assert rig.supervisor.arm(rig.now)
    sent = rig.run(5.0)
    assert all(command is None or not command.thrust.any() for command in sent)
    assert any('gimbal3 is 1.50 rad from its place' in text for text in rig.texts('error'))


@pytest.mark.parametrize('source, name, delay', [
    ('estimate', 'ekf_node', ESTIMATE_TIMEOUT),
    ('joints', 'joint_bridge_node', JOINT_TIMEOUT)])
def test_silent_estimator_or_joints_lead_to_a_landing_that_names_the_node(source, name, delay):
    rig = flown()
    rig.alive.discard(source)
    rig.run(delay + 2 * TICK)
    assert rig.supervisor.state == 'landing' and rig.supervisor.source == 'hover'
    assert any(text.startswith(f'{name} silent for') for text in rig.texts('error'))
    assert rig.supervisor.inputs.backup.running == (source == 'estimate')


def test_loss_of_all_sensors_stops_the_motors():
    rig = flown()
    rig.alive -= {'estimate', 'imu', 'mocap'}
    rig.run(1.0)
    assert rig.supervisor.state == 'emergency_stop'
    assert any('no estimator, no MoCap, no IMU' in text for text in rig.texts('error'))


def test_low_battery_warns_then_lands():
    rig = VehicleRig().fly()
    rig.supervisor.inputs.watch._pack = None   # the voltage falls without a load
    full = rig.voltage
    rig.voltage = (PARAMETERS.battery_land - 0.05) * ROBOT.battery.cells
    rig.run(LOW_TIME / 2)     # the sag of a manoeuvre
    rig.voltage = full
    rig.run(LOW_TIME)
    assert not any('battery' in t for t in rig.texts())
    rig.voltage = (PARAMETERS.battery_warn - 0.05) * ROBOT.battery.cells
    rig.run(3.0)
    assert rig.supervisor.state == 'flying' and any('battery low' in t for t in rig.texts())
    rig.voltage = (PARAMETERS.battery_land - 0.05) * ROBOT.battery.cells
    rig.run(LOW_TIME - 0.1)
    assert rig.supervisor.state == 'flying'
    rig.run(0.2)
    assert rig.supervisor.state == 'landing'


def test_a_pack_that_sags_under_the_same_load_leads_to_a_landing_within_half_a_second():
    rig = flown()
    rig.run(1.0)
    assert rig.supervisor.inputs.health.healthy
    rig.voltage -= 6.0
    rig.run(0.5)
    assert rig.supervisor.state == 'landing' and 'battery_weak' in rig.supervisor.faults
    limit = rig.supervisor.inputs.health.thrust_limit
    assert ROBOT.hover_thrust < limit < 2 * ROBOT.hover_thrust
    assert all(command.thrust.max() <= limit + 1e-9 for command in rig.run(0.5))


@pytest.mark.parametrize('height, climbs', [(0.6, True), (1.6, False)])
def test_with_a_weak_pack_a_low_robot_on_its_back_climbs_before_it_turns_over(height, climbs):
    rig = flown()
    supervisor, start = rig.supervisor, rig.position
    end = np.array([0.3, -0.2, supervisor.inputs.floor + height])
    for part in np.linspace(0.0, 1.0, 500):
        rig.quaternion = rotations.from_rpy(np.pi * part, 0.0, 0.0)
        rig.position = (1 - part) * start + part * end
        rig.run(TICK)
    rig.voltage -= 6.0
    rig.run(0.5)
    assert supervisor.state == 'landing' and 'battery_weak' in supervisor.faults
    way = supervisor.target_override
    turned = [inclination(quaternion) < 0.5 * np.pi for quaternion in way.quaternions]
    assert any(turned) is not climbs
    if climbs:
        top = supervisor.inputs.floor + TURN_HEIGHT
        assert way.positions[-1, 2] > top
        while rig.position[2] <= top and rig.now < way.times[-1]:
            rig.position = way.at(rig.now).position
            rig.run(TICK)
        rig.run(1.0)
        assert inclination(supervisor.target_override.quaternions[-1]) < 0.5


@pytest.mark.parametrize('motion', [{'rate': np.array([20.0, 0, 0])},
                                    {'velocity': np.array([0, 0, -8.0])}])
def test_a_tumbling_or_falling_robot_falls_back(motion):
    rig = flown()
    vars(rig).update(motion)
    rig.run(LOST_TIME - 0.02)
    assert rig.supervisor.state == 'flying'
    rig.run(0.6)
    assert rig.supervisor.mode == 'fallback:control_lost'


def test_a_clock_set_back_in_flight_is_tolerated():
    rig = flown()
    rig.now -= 30.0
    rig.run(1.0)
    assert rig.supervisor.state == 'flying'
    assert any('the clock went back by' in text for text in rig.texts('warning'))
    rig.alive.discard('estimate')
    rig.run(0.2)
    rig.now -= 30.0
    sent = rig.run(0.5)
    assert rig.supervisor.state == 'landing'
    assert all(command is not None for command in sent[2:])


@pytest.mark.parametrize('change, reason', [
    ({'position': np.full(3, np.nan)}, 'not finite'),
    ({'quaternion': np.array([0, 0, 0, 2.0])}, 'no unit quaternion'),
    ({'stamp': 90.0}, 'stale stamp'), ({'stamp': 200.0}, 'stamp in the future'),
    ({'stamp': 0.0, '_repeat': True}, 'repeated or older stamp')])
def test_bad_estimates_are_refused_and_counted(change, reason):
    rig = VehicleRig()
    rig.run(0.1)
    repeat = change.pop('_repeat', False)
    good = rig.supervisor.inputs.estimate
    bad = good if repeat else replace(good, **{'stamp': rig.now + TICK, **change})
    assert not rig.supervisor.inputs.on_state(bad)
    assert rig.supervisor.diagnostics()[f'refused.estimate: {reason}'] == 1
    assert rig.supervisor.inputs.estimate is good


@pytest.mark.parametrize('change, refused', [
    ({'position': np.array([1.5, 0, 0])}, True), ({'position': np.array([0.5, 0, 0])}, False),
    ({'quaternion': rotations.from_rpy(1.5, 0, 0)}, True),
    ({'quaternion': rotations.from_rpy(0, -0.5, 0)}, False)])
def test_a_single_jump_of_the_estimate_is_refused_and_a_lasting_one_accepted(change, refused):
    rig = VehicleRig()
    rig.run(0.1)
    supervisor = rig.supervisor
    good = supervisor.inputs.estimate
    jumped = [replace(good, stamp=rig.now + k * TICK, **{
        name: good.position + value if name == 'position' else value
        for name, value in change.items()}) for k in (1, 2)]
    assert rig.supervisor.inputs.on_state(jumped[0]) is not refused
    assert supervisor.inputs.estimate is (good if refused else jumped[0])
    answer = Command(jumped[0].stamp, good.tilt, np.full(4, 7.0))
    assert supervisor.inputs.on_command('nmpc', answer, rig.now + TICK) is not refused
    assert rig.supervisor.inputs.on_state(jumped[1])
    assert supervisor.inputs.estimate is jumped[1]
