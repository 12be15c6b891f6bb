"""Each effect of sensors and timing, added to the readings, is recovered."""

from dataclasses import replace

from flights import BODY, KEYS, model, Motion, P, ROBOT, solved, STEP
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.gap.keys import all_keys, extra_keys, names_of
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.robot.effects import CATALOGUE, treatment

MOTION = Motion(5)
NEUTRAL = dict(model(MOTION.flight()).residual({}).items())


def readings():
    return np.concatenate([MOTION.specific_force, MOTION.rate], axis=1)


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
                                  and treatment('gap', name).acts])
def test_a_fit_begins_at_the_sensor_effects_of_the_robot_file(name):
    parameter, = CATALOGUE[name].numbers
    spec = CATALOGUE[name].parameters[parameter]
    known = replace(ROBOT, effects={name: {parameter: (np.array(spec.neutral)
                                                       + spec.typical).tolist()}})
    keys = {**all_keys(known), **extra_keys()}
    given = FlightModel(MOTION.flight(), known, BODY, keys, P).residual({})
    theta = dict.fromkeys(names_of(name, parameter), spec.typical)
    fitted = FlightModel(MOTION.flight(), ROBOT, BODY, KEYS, P).residual(theta)
    for group in given:
        assert given[group] == pytest.approx(fitted[group], abs=1e-9)
    assert keys[names_of(name, parameter)[0]].value(0.0) == pytest.approx(spec.typical)
