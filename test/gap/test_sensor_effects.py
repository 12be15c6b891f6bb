"""Each effect of sensors and timing, added to the readings, is recovered."""

from dataclasses import replace

from flights import BODY, model, Motion, PLACE, ROBOT, solved, STEP
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.keys import all_keys, extra_keys, names_of, Prior
from beetle_omni_ros.identify.flights.linearised import Linearised
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.recording.bag import changed, JOINTS
from beetle_omni_ros.model.effects import CATALOGUE, ignored

MOTION = Motion(5)
NEUTRAL = dict(model(MOTION.flight()).residual({}).items())


def readings():
    return np.concatenate([MOTION.specific_force, MOTION.rate], axis=1)


def slopes_of(made, names):
    return made.linear({}, names).slopes[:, PLACE['J']]


def recovered(flight, names, groups):
    found = solved(model(flight), names, groups, NEUTRAL)
    return np.array([found[name] for name in names])


@pytest.mark.parametrize('name, groups, reading', [
    ('imu_filter_lag', 'AW', 'imu_delay'), ('mocap_time_offset', 'AW', 'pose_delay'),
    ('joint_feedback_delay', 'J', 'joint_delay')])
def test_the_delay_of_a_reading_is_recovered(name, groups, reading):
    flight = MOTION.flight(**{reading: 0.012})
    assert recovered(flight, [f'{name}.delay'], groups) == pytest.approx([0.012], abs=3e-4)


@pytest.mark.parametrize('name, part', [('imu_accelerometer_bias', 0), ('imu_gyroscope_bias', 3)])
def test_a_bias_equals_the_added_constant(name, part):
    true = np.array([0.1, -0.05, 0.2])
    imu = readings()
    imu[:, part:part + 3] += true
    names = [f'{name}.bias[{k}]' for k in range(3)]
    assert recovered(MOTION.flight(imu=imu), names, 'AW') == pytest.approx(true, abs=2e-3)


def test_a_turned_imu_is_recovered_as_its_axes_seen_from_base_link():
    true = np.array([0.05, -0.08, 0.1])
    axes = Rotation.from_rotvec(true)       # of the sensor, in base_link
    imu = np.concatenate([axes.inv().apply(MOTION.specific_force),
                          axes.inv().apply(MOTION.rate)], axis=1)
    names = [f'imu_misalignment.rotation[{k}]' for k in range(3)]
    assert recovered(MOTION.flight(imu=imu), names, 'AW') == pytest.approx(true, abs=2e-3)


def test_turned_markers_are_recovered_as_their_axes_seen_from_base_link():
    true = np.array([-0.06, 0.04, 0.09])
    names = [f'mocap_misalignment.rotation[{k}]' for k in range(3)]
    flight = MOTION.flight(pose=MOTION.attitude * Rotation.from_rotvec(true))
    assert recovered(flight, names, 'AW') == pytest.approx(true, abs=2e-3)


def test_a_lever_arm_is_the_position_of_the_imu():
    true = np.array([0.03, -0.02, 0.05])
    turning = np.gradient(MOTION.rate, STEP, axis=0)
    imu = readings()
    imu[:, :3] += np.cross(turning, true) + np.cross(MOTION.rate, np.cross(MOTION.rate, true))
    names = [f'imu_lever_arm.offset[{k}]' for k in range(3)]
    assert recovered(MOTION.flight(imu=imu), names, 'A') == pytest.approx(true, abs=1e-3)


@pytest.mark.parametrize('name', [name for name, effect in CATALOGUE.items()
                                  if any(map(effect.in_readings, effect.parameters))
                                  and not ignored('gap', name)])
def test_a_fit_begins_at_the_sensor_effects_of_the_robot_file(name):
    parameter, = CATALOGUE[name].numbers
    neutral = CATALOGUE[name].parameters[parameter].neutral
    typical = TREATMENTS[name].sizes[parameter].typical
    known = replace(ROBOT, effects={name: {parameter: (np.array(neutral) + typical).tolist()}})
    keys = {**all_keys(known), **extra_keys(known)}
    given = model(MOTION.flight(), known, BODY, keys).residual({})
    theta = dict.fromkeys(names_of(name, parameter), typical)
    fitted = model(MOTION.flight()).residual(theta)
    for group in given:
        assert given[group] == pytest.approx(fitted[group], abs=1e-9)
    assert keys[names_of(name, parameter)[0]].value(0.0) == pytest.approx(typical)


DELAY = 'joint_feedback_delay.delay'


def noisy(tilt=0.0, **late):
    """A flight with noise of the encoders as large as in the publication or larger [rad]."""
    rng, flight = np.random.default_rng(3), MOTION.flight(**late)
    joint = flight.values[JOINTS]
    return changed(flight, JOINTS, values=joint + tilt * rng.standard_normal(joint.shape))


def at(made, series):
    """Series (N, n) at 200 Hz at the times of a model's grid."""
    return np.stack([np.interp(made.signals.t, MOTION.t, x) for x in series.T], axis=1)


def rms(x):
    return float(np.sqrt((x**2).mean()))


@pytest.mark.parametrize('name', [DELAY, 'imu_filter_lag.delay'])
def test_derivatives_by_a_delay_contain_no_encoder_noise(name):
    slopes = [slopes_of(model(noisy(tilt)), [name]) for tilt in (0.0, 0.02)]
    clean = slopes_of(model(noisy()), [DELAY])
    assert rms(slopes[1] - slopes[0]) < 0.02 * rms(clean)


def test_what_all_sensors_and_commands_are_late_by_is_not_seen():
    # else a linear fit would exploit the difference between equivalent delays
    late = {'imu_filter_lag.delay': -1, 'mocap_time_offset.delay': -1, DELAY: -1,
            'base.tilt_delay': 1, 'base.thrust_delay': 1}
    parts = model(MOTION.flight()).linear({}, list(late)).slopes * list(late.values())
    for own in PLACE.values():
        assert rms(parts[:, own].sum(axis=2)) < 2e-3 * rms(parts[:, own])


def test_the_delay_of_noisy_encoders_is_recovered():
    found = solved(model(noisy(0.02, joint_delay=0.012)), [DELAY], 'J')
    assert found[DELAY] == pytest.approx(0.012, abs=1e-3)


def test_tilts_follow_the_servo_model_if_encoders_are_noisy():
    made = model(noisy(0.02))
    inside = slice(100, -150)
    truth = at(made, MOTION.tilt), at(made, MOTION.tilt_acceleration)
    before = [made.signals.joints({})[k] - truth[j] for j, k in enumerate((0, 2))]
    made.settle({})
    after = [made.signals.joints({})[k] - truth[j] for j, k in enumerate((0, 2))]
    assert rms(after[0][inside]) < 0.35 * rms(before[0][inside])
    assert rms(after[1][inside]) < 0.05 * rms(before[1][inside])


def test_late_tilt_commands_also_move_the_body_if_encoders_are_noisy():
    name, h, made = 'base.tilt_delay', 1e-3, [model(noisy(0.02)) for _ in range(2)]
    for each, theta in zip(made, ({}, {name: h}), strict=True):
        each.settle(theta)      # the tilts of the body are those of the servo model
    slopes = made[0].linear({}, [name]).slopes[:, PLACE['B'], 0]
    moved = (made[1].residual({name: h}, 'B')['B'] - made[0].residual({}, 'B')['B']) / h
    assert rms(moved) > 1e-3 and rms(slopes - moved) < 0.1 * rms(moved)


@pytest.mark.parametrize('noise, hidden', [(0.0, set()), (0.003, {4, 5, 6, 7})])
def test_encoder_noise_hides_joints_in_the_bands_in_which_they_do_not_move(noise, hidden):
    # tilts move below 0.5 Hz, bands 4 to 7 begin at 1 Hz
    flights = Linearised([model(noisy(noise))], {DELAY: Prior(6e-4, 0.01, 0.0)}, [])
    flights._whiten(np.zeros(len(flights.names)), np.zeros((1, len(flights.names))))
    still = {band for band, own in flights.still[0] if flights.channels[own[0]] == 'joint_1'}
    assert hidden <= still and not still & ({1, 2} | (set() if noise else {3, 4, 5, 6, 7}))


@pytest.mark.parametrize('gain', ['kp', 'kd'])
def test_derivatives_by_the_gain_of_a_servo_agree_with_its_joint(gain):
    made, own = model(MOTION.flight()), [f'servo.{gain}[{k}]' for k in range(4)]
    slopes, h = slopes_of(made, [f'joint_bandwidth.{gain}', *own]), 0.01
    for k, name in enumerate(own):
        ahead, behind = (made.residual({name: x}, 'J')['J'] for x in (h, -h))
        moved = (ahead - behind) / (2 * h)
        assert np.abs(moved[:, k]).max() > 1e-3
        assert slopes[:, :, k + 1] == pytest.approx(moved, abs=1e-9)
    assert slopes[:, :, 1:].sum(axis=2) == pytest.approx(slopes[:, :, 0], abs=1e-12)
