"""Unusable recordings are refused in one line with the reason."""

from dataclasses import replace

from flights import model, Motion, P, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.identify.recording.bag import BATTERY, COMMAND, IMU, Recording
from beetle_omni_ros.identify.recording.flight import prepare, UnusableFlight
from beetle_omni_ros.identify.recording.parameters import GapParameters


def recording(duration=16.0):
    motion = Motion(duration=duration)
    flight = motion.flight()
    return Recording('case', flight.times | {COMMAND: flight.times[COMMAND] + 0.02},
                     flight.values | {BATTERY: np.column_stack([motion.voltage, motion.current])})


def refused(made, *words):
    with pytest.raises(UnusableFlight) as error:
        prepare(made, ROBOT, P)
    text = str(error.value)
    assert '\n' not in text and text.startswith('case: ')
    assert error.value.problems and all(d.topic and d.cause for d in error.value.problems)
    for word in words:
        assert word in text
    return error.value.problems


def cut(made, topic, keep):
    made.times[topic], made.values[topic] = made.times[topic][keep], made.values[topic][keep]
    return made


@pytest.mark.parametrize('topic', ['imu/data_raw', 'mocap/pose', 'joint_states', 'command'])
def test_a_missing_topic_is_named(topic):
    refused(cut(recording(), topic, slice(0, 0)), topic, 'missing')


def test_long_sensor_gaps_are_refused_and_short_ones_cut_out():
    made = recording()
    t = made.times['imu/data_raw']
    silence, = refused(cut(made, 'imu/data_raw', (t < 5) | (t > 9)), 'imu/data_raw', 'silent')
    assert silence.topic == 'imu/data_raw' and silence.at_s == pytest.approx(5.0, abs=0.02)
    made = recording(24.0)
    t = made.times['joint_states']
    flight = prepare(cut(made, 'joint_states', (t < 6) | (t > 6.4)), ROBOT, P)
    assert flight.start > 6 and flight.findings


def shortened(end):
    made = recording()
    for topic, t in made.times.items():
        cut(made, topic, t < end)
    return made


def test_a_short_recording_is_refused_unless_the_engine_can_use_it():
    refused(shortened(6.0), 's of usable flight')
    p = GapParameters.load(least_duration=4.0)      # the smallest value
    assert model(prepare(shortened(5.5), ROBOT, p)).usable
    with pytest.raises(UnusableFlight, match='s of usable flight'):
        prepare(shortened(4.0), ROBOT, p)


def test_a_recording_on_the_ground_or_of_another_robot_is_refused():
    made = recording()
    made.values['command'][:, 4:] = 0.0
    refused(made, 'does not fly')
    with pytest.raises(UnusableFlight, match='robot file does not fit'):
        prepare(recording(), replace(ROBOT, mass=0.25 * ROBOT.mass), P)


def test_nan_readings_are_omitted_and_counted():
    made = recording()
    made.values['imu/data_raw'][100:104] = np.nan
    flight = prepare(made, ROBOT, P)
    assert any('4 messages' in text for text in flight.findings)
    assert np.isfinite(flight.values[IMU]).all()
