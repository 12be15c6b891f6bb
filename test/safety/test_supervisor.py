"""Each transition of the state machine, with a kinematic vehicle."""

from dataclasses import replace

import numpy as np
from puppet import flown, hover_command, PARAMETERS, Puppet, ROBOT, TICK
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.safety.parameters import SupervisorParameters

TIMEOUT = PARAMETERS.commands.timeout


def test_nothing_is_sent_before_arming():
    puppet = Puppet()
    assert set(puppet.run(1.0)) == {None}
    assert puppet.supervisor.state == 'disarmed' and puppet.supervisor.source == 'none'


def test_takes_off_by_hover_and_hands_over():
    puppet = Puppet()
    puppet.run(0.6)
    assert puppet.supervisor.arm(puppet.now)
    puppet.run(0.1)
    assert puppet.supervisor.state == 'takeoff' and puppet.supervisor.source == 'hover'
    puppet.run(4.0)
    assert puppet.supervisor.state == 'flying' and puppet.supervisor.source == 'nmpc'
    np.testing.assert_allclose(puppet.command.thrust, hover_command(0.0).thrust)


@pytest.mark.parametrize('spoil, text', [
    (lambda p: p.alive.discard('estimate'), 'ekf_node never heard'),
    (lambda p: setattr(p, 'status', 'dead_reckoning'), "'dead_reckoning', not 'tracking'"),
    (lambda p: setattr(p, 'status', 'lost'), 'no fresh state estimate'),
    (lambda p: p.alive.discard('joints'), 'joint_bridge_node never heard'),
    (lambda p: setattr(p, 'quaternion', rotations.from_rpy(1.0, 0, 0)), 'inclined by 57 deg'),
    (lambda p: setattr(p, 'velocity', np.array([0.5, 0, 0])), 'moving at 0.50 m/s'),
    (lambda p: setattr(p, 'rate', np.array([0, 0, 1.0])), 'turning at 1.00 rad/s'),
    (lambda p: setattr(p, 'position', np.array([30.0, 0, 0])), 'outside the fence'),
    (lambda p: setattr(p, 'voltage', 20.0), 'battery at 20.0 V')])
def test_arming_is_refused_with_the_reason(spoil, text):
    puppet = Puppet()
    spoil(puppet)
    puppet.run(0.3)
    answer = puppet.supervisor.arm(puppet.now)
    assert not answer and text in answer.text
    assert puppet.supervisor.state == 'disarmed' and set(puppet.run(0.1)) == {None}
    assert any(text in said for said in puppet.texts('warning'))


def test_silent_controller_falls_back_to_hover_without_a_jump_and_gets_control_back():
    puppet = flown()
    before = puppet.command
    puppet.alive.discard('nmpc')
    puppet.run(TIMEOUT - TICK)
    assert puppet.supervisor.state == 'flying'
    puppet.run(TICK)
    assert puppet.supervisor.state == 'fallback' and puppet.supervisor.source == 'hover'
    assert any(text.startswith('nmpc_node silent for 50 ms') and 'fallback' in text
               for text in puppet.texts('error'))
    assert np.abs(puppet.command.tilt - before.tilt).max() < 0.2
    assert np.abs(puppet.command.thrust - before.thrust).max() < 7
    puppet.alive.add('nmpc')
    puppet.run(PARAMETERS.commands.return_after - 2 * TICK)
    assert puppet.supervisor.state == 'fallback'
    puppet.run(4 * TICK)
    assert puppet.supervisor.state == 'flying' and puppet.supervisor.source == 'nmpc'


def test_fallback_holds_the_pose_at_which_it_began():
    puppet = flown()
    puppet.quaternion = rotations.from_rpy(1.2, 0.4, -2.0)
    puppet.run(0.2)
    puppet.alive.discard('nmpc')
    puppet.run(0.2)
    goal = puppet.supervisor._target.at(puppet.now)
    np.testing.assert_array_equal(goal.position, puppet.position)
    np.testing.assert_array_equal(goal.quaternion, puppet.quaternion)


def test_a_controller_with_invalid_commands_only_counts_as_silent_with_the_reason():
    puppet = flown()
    puppet.alive.discard('nmpc')
    for _ in range(20):
        puppet.supervisor.on_command('nmpc', Command(puppet.now, np.full(4, np.nan), np.ones(4)),
                                     puppet.now)
        puppet.run(TICK)
    assert puppet.supervisor.state == 'fallback'
    assert any('last refused: not finite' in text for text in puppet.texts('error'))
    assert puppet.supervisor.diagnostics()['nmpc.refused.not finite'] == 20


def test_a_controller_that_oscillates_at_the_limits_keeps_control():
    puppet = flown()
    puppet.alive.discard('nmpc')
    top = ROBOT.rotors.thrust_max
    for k in range(30):
        puppet.supervisor.on_command('nmpc', Command(
            puppet.now, 0.01 * np.arange(4) + 1e-6 * k, np.array([top + 2.0, 7.0, 7.0, -2.0])),
            puppet.now)
        puppet.run(TICK)
        assert puppet.supervisor.state == 'flying'
    assert puppet.command.thrust[0] == top and puppet.command.thrust[3] == 0.0
    assert puppet.supervisor.diagnostics()['nmpc.refused.thrust out of range'] >= 29


def test_hover_lasts_until_the_controller_is_present_for_the_handover():
    puppet = Puppet()
    puppet.alive.discard('nmpc')
    puppet.run(0.6)
    puppet.supervisor.arm(puppet.now)
    puppet.run(5.0)
    assert puppet.supervisor.state == 'fallback'
    puppet.alive.add('nmpc')
    puppet.run(0.6)
    assert puppet.supervisor.state == 'flying'


def test_selecting_in_flight_needs_a_good_controller():
    puppet = Puppet()
    puppet.alive.discard('rl')
    puppet.fly()
    answer = puppet.supervisor.select('rl')
    assert not answer and 'rl_node never heard; nmpc stays selected' in answer.text
    assert puppet.supervisor.active == 'nmpc'
    puppet.alive.add('rl')
    puppet.run(0.2)
    assert 'good for only' in puppet.supervisor.select('rl').text
    puppet.run(0.4)
    assert puppet.supervisor.select('rl')
    puppet.run(TICK)
    assert puppet.supervisor.source == 'rl' and puppet.supervisor.state == 'flying'
    unknown = puppet.supervisor.select('pid')
    assert not unknown and "unknown controller 'pid'" in unknown.text


def test_on_the_ground_any_controller_can_be_selected():
    puppet = Puppet()
    puppet.alive -= {'rl', 'nmpc'}
    puppet.run(0.1)
    assert puppet.supervisor.select('rl') and puppet.supervisor.active == 'rl'


def test_emergency_stop_is_latched_until_disarmed():
    puppet = flown()
    assert puppet.supervisor.emergency_stop(puppet.now)
    sent = puppet.run(1.0)
    stop_ticks = round(PARAMETERS.stop_time / TICK)
    assert all(not command.thrust.any() for command in sent[:stop_ticks])
    assert set(sent[stop_ticks + 1:]) == {None}
    assert not puppet.supervisor.arm(puppet.now) and not puppet.supervisor.land(puppet.now)
    assert puppet.supervisor.state == 'emergency_stop'
    assert puppet.supervisor.disarm(puppet.now) and puppet.supervisor.state == 'disarmed'
    puppet.position = np.array([0, 0, 0.16])
    assert puppet.supervisor.arm(puppet.now)


def test_disarming_is_refused_in_the_air_and_granted_on_the_ground():
    puppet = Puppet()
    puppet.lifts = False
    puppet.run(0.6)
    puppet.supervisor.arm(puppet.now)
    puppet.run(0.2)
    assert puppet.supervisor.disarm(puppet.now)
    flying = flown()
    answer = flying.supervisor.disarm(flying.now)
    assert not answer and 'land or emergency_stop' in answer.text
    assert flying.supervisor.state == 'flying'


def test_a_takeoff_without_lift_off_is_aborted():
    puppet = Puppet()
    puppet.lifts = False
    puppet.run(0.6)
    puppet.supervisor.arm(puppet.now)
    puppet.run(10.0)
    assert puppet.supervisor.state == 'disarmed'
    assert any('still on the ground' in text for text in puppet.texts('error'))


def test_joint_that_does_not_follow_stops_the_takeoff_before_the_rotors_start():
    puppet = Puppet()
    stuck = np.array([0.0, 0.0, 1.5, 0.0])
    talk = puppet._talk

    def with_stuck_joint():
        talk()
        puppet.supervisor.vehicle.tilt = stuck

    puppet._talk = with_stuck_joint
    puppet.run(0.6)
    assert puppet.supervisor.arm(puppet.now)
    sent = puppet.run(5.0)
    assert all(command is None or not command.thrust.any() for command in sent)
    assert any('gimbal3 is 1.50 rad from its place' in text for text in puppet.texts('error'))


@pytest.mark.parametrize('source, name, delay', [
    ('estimate', 'ekf_node', PARAMETERS.state.timeout),
    ('joints', 'joint_bridge_node', PARAMETERS.state.joint_timeout)])
def test_silent_estimator_or_joints_lead_to_a_landing_that_names_the_node(source, name, delay):
    puppet = flown()
    puppet.alive.discard(source)
    puppet.run(delay + 2 * TICK)
    assert puppet.supervisor.state == 'landing' and puppet.supervisor.source == 'hover'
    assert any(text.startswith(f'{name} silent for') for text in puppet.texts('error'))
    assert puppet.supervisor.vehicle.backup.running == (source == 'estimate')


def test_estimator_that_reports_lost_counts_as_silent():
    puppet = flown()
    puppet.status = 'dead_reckoning'
    puppet.run(0.5)
    assert puppet.supervisor.state == 'flying'
    puppet.status = 'lost'
    puppet.run(0.1)
    assert puppet.supervisor.state == 'landing'
    assert any("last refused: status 'lost'" in text for text in puppet.texts('error'))


def test_loss_of_all_sensors_stops_the_motors():
    puppet = flown()
    puppet.alive -= {'estimate', 'imu', 'mocap'}
    puppet.run(1.0)
    assert puppet.supervisor.state == 'emergency_stop'
    assert any('no estimator, no MoCap, no IMU' in text for text in puppet.texts('error'))


def test_a_fault_before_lift_off_stops_the_motors():
    puppet = Puppet()
    puppet.lifts = False
    puppet.run(0.6)
    puppet.supervisor.arm(puppet.now)
    puppet.run(0.1)
    puppet.alive.discard('estimate')
    puppet.run(0.1)
    assert puppet.supervisor.state == 'disarmed'
    assert any('still on the ground: motors off' in text for text in puppet.texts('error'))


def test_low_battery_warns_then_lands():
    # Without the resistance: only the voltage falls suddenly and recovers.
    detection = replace(PARAMETERS.detection, battery=replace(
        PARAMETERS.detection.battery, time=10.0))
    puppet = Puppet(replace(PARAMETERS, detection=detection)).fly()
    full = puppet.voltage
    puppet.voltage = (PARAMETERS.battery.land - 0.05) * ROBOT.battery.cells
    puppet.run(PARAMETERS.battery.time / 2)     # the sag of a manoeuvre
    puppet.voltage = full
    puppet.run(PARAMETERS.battery.time)
    assert not any('battery' in t for t in puppet.texts())
    puppet.voltage = (PARAMETERS.battery.warn - 0.05) * ROBOT.battery.cells
    puppet.run(3.0)
    assert puppet.supervisor.state == 'flying' and any('battery low' in t for t in puppet.texts())
    puppet.voltage = (PARAMETERS.battery.land - 0.05) * ROBOT.battery.cells
    puppet.run(PARAMETERS.battery.time - 0.1)
    assert puppet.supervisor.state == 'flying'
    puppet.run(0.2)
    assert puppet.supervisor.state == 'landing'


def test_a_pack_that_sags_under_the_same_load_leads_to_a_landing_within_half_a_second():
    puppet = flown()
    puppet.run(1.0)
    assert puppet.supervisor.health.healthy
    puppet.voltage -= 6.0
    puppet.run(0.5)
    assert puppet.supervisor.state == 'landing' and 'battery_weak' in puppet.supervisor.faults
    limit = puppet.supervisor.health.thrust_limit
    assert ROBOT.hover_thrust < limit < 2 * ROBOT.hover_thrust
    assert all(command.thrust.max() <= limit + 1e-9 for command in puppet.run(0.5))


@pytest.mark.parametrize('reaction, state', [
    ('none', 'flying'), ('landing', 'landing'), ('emergency_stop', 'emergency_stop')])
def test_fence_reaction_is_a_parameter(reaction, state):
    puppet = Puppet(replace(PARAMETERS, envelope=replace(PARAMETERS.envelope,
                                                         fence_reaction=reaction))).fly()
    puppet.position = np.array([0.0, 25.0, 1.0])
    puppet.run(0.1)
    assert puppet.supervisor.state == state


@pytest.mark.parametrize('reaction, state', [
    ('none', 'flying'), ('fallback', 'fallback'), ('landing', 'landing'),
    ('emergency_stop', 'emergency_stop')])
@pytest.mark.parametrize('motion', ['tumbling', 'falling'])
def test_lost_control_reaction_is_a_parameter(motion, reaction, state):
    puppet = Puppet(replace(PARAMETERS, envelope=replace(PARAMETERS.envelope,
                                                         lost_reaction=reaction))).fly()
    if motion == 'tumbling':
        puppet.rate = np.array([20.0, 0, 0])
    else:
        puppet.velocity = np.array([0, 0, -8.0])
    puppet.run(PARAMETERS.envelope.lost_time - 0.02)
    assert puppet.supervisor.state == 'flying'
    puppet.run(0.6)
    assert puppet.supervisor.state == state


def test_any_attitude_is_permitted():
    puppet = flown()
    rng = np.random.default_rng(0)
    for _ in range(20):
        puppet.quaternion = rotations.normalized(rng.normal(size=4))
        puppet.run(0.05)
    assert puppet.supervisor.state == 'flying'


def test_a_delayed_supervisor_reports_no_silence_and_sends_no_old_command():
    puppet = flown()
    puppet.now += 3.0
    assert puppet.supervisor.update(puppet.now) is None
    puppet.run(0.1)
    assert puppet.supervisor.state == 'flying' and puppet.command is not None


def test_a_clock_set_back_in_flight_is_tolerated():
    puppet = flown()
    puppet.now -= 30.0
    puppet.run(1.0)
    assert puppet.supervisor.state == 'flying'
    assert any('the clock went back by' in text for text in puppet.texts('warning'))
    puppet.alive.discard('estimate')
    puppet.run(0.2)
    puppet.now -= 30.0
    sent = puppet.run(0.5)
    assert puppet.supervisor.state == 'landing'
    assert all(command is not None for command in sent[2:])


@pytest.mark.parametrize('change, reason', [
    ({'position': np.full(3, np.nan)}, 'not finite'),
    ({'velocity': np.full(3, 1e300)}, 'absurdly large'),
    ({'quaternion': np.array([0, 0, 0, 2.0])}, 'no unit quaternion'),
    ({'stamp': 90.0}, 'stale stamp'), ({'stamp': 200.0}, 'stamp in the future'),
    ({'stamp': 0.0, '_repeat': True}, 'repeated or older stamp')])
def test_bad_estimates_are_refused_and_counted(change, reason):
    puppet = Puppet()
    puppet.run(0.1)
    repeat = change.pop('_repeat', False)
    good = puppet.supervisor.vehicle.state
    bad = good if repeat else replace(good, **{'stamp': puppet.now + TICK, **change})
    assert not puppet.supervisor.on_state(bad)
    assert puppet.supervisor.diagnostics()[f'refused.estimate: {reason}'] == 1
    assert puppet.supervisor.vehicle.state is good


@pytest.mark.parametrize('change, refused', [
    ({'position': np.array([1.5, 0, 0])}, True), ({'position': np.array([0.5, 0, 0])}, False),
    ({'quaternion': rotations.from_rpy(1.5, 0, 0)}, True),
    ({'quaternion': rotations.from_rpy(0, -0.5, 0)}, False)])
def test_a_single_jump_of_the_estimate_is_refused_and_a_lasting_one_accepted(change, refused):
    puppet = Puppet()
    puppet.run(0.1)
    vehicle = puppet.supervisor.vehicle
    good = vehicle.state
    jumped = [replace(good, stamp=puppet.now + k * TICK, **{
        name: good.position + value if name == 'position' else value
        for name, value in change.items()}) for k in (1, 2)]
    assert puppet.supervisor.on_state(jumped[0]) is not refused
    assert vehicle.state is (good if refused else jumped[0])
    assert puppet.supervisor.on_state(jumped[1])
    assert vehicle.state is jumped[1]


def test_random_estimates_move_no_joint_before_the_descent_on_raw_sensors():
    puppet, random = flown(), np.random.default_rng(1)
    before = puppet.command
    puppet.alive.discard('estimate')
    for _ in range(40):
        row = random.standard_normal(13)
        puppet.supervisor.on_state(replace(
            puppet.supervisor.vehicle.state, stamp=puppet.now, position=3 * row[:3],
            velocity=3 * row[3:6], quaternion=rotations.normalized(row[6:10]),
            angular_velocity=3 * row[10:]))
        puppet.run(TICK)
        if puppet.supervisor.state == 'landing':
            break
        assert np.max(np.abs(puppet.command.tilt - before.tilt)) < 0.1
    assert puppet.supervisor.state == 'landing'
    assert 'estimator_lost' in puppet.supervisor.faults


def test_command_of_an_unknown_controller_is_counted_and_not_executed():
    puppet = flown()
    assert not puppet.supervisor.on_command('pid', hover_command(puppet.now), puppet.now)
    assert puppet.supervisor.diagnostics()['refused.unknown controller'] == 1


def test_untimely_requests_are_refused_with_the_reason():
    puppet = Puppet()
    puppet.run(0.1)
    assert 'not in flight' in puppet.supervisor.land(puppet.now).text
    puppet.fly()
    assert 'flying, not disarmed' in puppet.supervisor.arm(puppet.now).text


def test_parameters_of_the_wrong_kind_are_named():
    from beetle_omni_ros.robot import schema
    with pytest.raises(schema.ParameterError, match='commands.timout.*timeout'):
        schema.bind(SupervisorParameters, {'commands': {'timout': 0.1}})


def test_an_impact_near_the_floor_stops_the_motors_for_good():
    puppet = flown()
    puppet.position = np.array([0.3, -0.2, 0.25])
    puppet.run(0.05)
    puppet.supervisor.on_imu(puppet.now + 0.001, np.array([0, 0, 120.0]), np.zeros(3))
    puppet.run(0.05)
    assert puppet.supervisor.state == 'flying', 'a lone sample is a spike of the sensor'
    for after in (0.001, 0.006):
        puppet.supervisor.on_imu(puppet.now + after, np.array([0, 0, 120.0]), np.zeros(3))
    sent = puppet.run(0.1)
    assert puppet.supervisor.state == 'emergency_stop'
    assert puppet.supervisor.reported_state == 'emergency_stop:crash'
    assert not sent[0].thrust.any()
    assert not puppet.supervisor.arm(puppet.now)


@pytest.mark.parametrize('height, stops', [(0.2, True), (0.8, False)])
def test_a_second_rotor_lost_at_the_floor_stops_the_motors_at_once(height, stops):
    puppet = Puppet().fly()
    puppet.supervisor.watch.health = ActuatorHealth(rotors=(True, False, True, True))
    puppet.run(TICK)
    assert puppet.supervisor.state == 'landing'
    puppet.position = np.array([0.3, -0.2, 0.16 + height])
    puppet.run(0.05)
    assert puppet.supervisor.state == 'landing'
    puppet.supervisor.watch.health = ActuatorHealth(rotors=(True, False, False, True))
    puppet.run(TICK)
    assert (puppet.supervisor.state in ('disarmed', 'emergency_stop')) == stops


def test_an_impact_high_above_the_floor_is_no_crash():
    puppet = flown()
    for after in (0.001, 0.006):
        puppet.supervisor.on_imu(puppet.now + after, np.array([0, 120.0, 0]), np.zeros(3))
    puppet.run(0.2)
    assert puppet.supervisor.state == 'flying'


def test_a_pause_in_the_air_ends_in_fallback_and_on_the_floor_with_motors_off():
    puppet = flown()
    puppet.now += 0.4
    puppet.run(0.02)
    assert 'supervisor_paused' in puppet.supervisor.faults
    assert puppet.supervisor.state in ('fallback', 'flying')
    puppet = flown()
    puppet.now += 1.0
    puppet.position = np.array([0.3, -0.2, 0.2])
    sent = puppet.run(0.5)
    assert puppet.supervisor.state in ('disarmed', 'emergency_stop')
    assert not any(command.thrust.any() for command in sent if command is not None)


@pytest.mark.parametrize('spoil', [
    lambda p: setattr(p, 'position', np.array([0.0, 0.0, 25.0])),
    lambda p: setattr(p, 'rate', np.array([20.0, 0.0, 0.0]))])
def test_limits_hold_while_landing(spoil):
    puppet = flown()
    puppet.supervisor.land(puppet.now)
    puppet.velocity = np.array([0.0, 0.0, -0.3])
    spoil(puppet)
    puppet.run(0.9)
    assert puppet.supervisor.state == 'landing'
    puppet.run(0.5)
    assert puppet.supervisor.state == 'emergency_stop'


def test_a_landing_from_the_highest_place_inside_the_limits_ends_before_its_time_limit():
    envelope, landing = PARAMETERS.envelope, PARAMETERS.landing
    turns = np.pi / landing.level.rate + landing.turnover.time_limit
    sinking = (envelope.height + envelope.fence_margin) / landing.speed
    assert sinking + turns < landing.time_limit


def test_landing_and_fallback_end_in_time():
    puppet = flown()
    puppet.alive -= {'nmpc', 'rl'}
    puppet.run(PARAMETERS.envelope.fallback_time + 0.2)
    assert puppet.supervisor.state == 'landing'
    puppet.velocity = np.array([0.0, 0.0, -0.3])
    puppet.run(PARAMETERS.landing.time_limit + 0.2)
    assert puppet.supervisor.state == 'emergency_stop'


def test_a_flip_of_the_markers_leads_to_a_landing_without_mocap():
    puppet = flown()
    attitude, puppet.quaternion = puppet.quaternion, rotations.from_rpy(0, 0, np.pi / 2)
    on_state = puppet.supervisor.on_state
    puppet.supervisor.on_state = lambda state, status: on_state(
        replace(state, quaternion=attitude), status)
    puppet.run(2.0)
    assert 'mocap_flipped' in puppet.supervisor.faults
    assert puppet.supervisor.state == 'landing'


def test_a_silent_imu_is_named_and_not_the_controller_that_waits_for_the_estimate():
    puppet = flown()
    puppet.alive -= {'imu', 'estimate', 'nmpc'}
    puppet.run(0.1)
    assert 'imu_lost' in puppet.supervisor.faults
    assert 'controller_silent' not in puppet.supervisor.faults


def test_one_frozen_axis_of_the_imu_is_named_and_the_flight_goes_on():
    puppet = flown()
    limit = PARAMETERS.detection.imu.axis_frozen
    talk = puppet.supervisor.on_imu
    puppet.supervisor.on_imu = lambda stamp, force, rate: talk(stamp, force, [0.0, *rate[1:]])
    puppet.run((limit - 1) * TICK)
    assert 'imu_axis_frozen' not in puppet.supervisor.faults
    puppet.run(3 * TICK)
    assert 'imu_axis_frozen' in puppet.supervisor.faults
    assert puppet.supervisor.state == 'flying' and not puppet.supervisor.vehicle.imu_lost
    puppet.alive.discard('estimate')    # the descent on raw sensors works without the IMU
    puppet.run(0.5)
    assert puppet.supervisor.state == 'landing' and puppet.supervisor.vehicle.imu_lost
    assert 'imu_lost' not in puppet.supervisor.faults
