"""Check of the topics: rates, ages, clocks, units, several publishers, bridges."""

from check_helpers import by_item, levels, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.drivers.check import check_topics, ObservedGraph, Stream


def stream(rate, age, jitter=0.001, size=9.81, seconds=3.0, seed=0):
    rng = np.random.default_rng(seed)
    arrivals = 100.0 + np.arange(0, seconds, 1 / rate)
    return Stream(arrivals=list(arrivals), ages=list(age + jitter * rng.random(len(arrivals))),
                  norms=list(size + 0.01 * rng.normal(size=len(arrivals))), publishers=['driver'])


def graph(**streams):
    made = {'mocap': stream(100, 0.010), 'imu': stream(200, 0.001)} | streams
    names = {'mocap': 'mocap/pose', 'imu': 'imu/data_raw', 'joints': 'joint_states',
             'battery': 'battery_state'}
    return ObservedGraph(5, 3.0, {names[key]: value for key, value in made.items()})


def judged(**streams):
    return by_item(check_topics(graph(**streams), ROBOT.gravity))


def test_good_sensors_without_bridges_pass():
    found = judged()
    assert levels(found) == {}
    assert found['mocap/pose rate'].values['rate_Hz'] == pytest.approx(100)
    assert 'joint_bridge_node does not run' in found['joint_states'].found


def test_a_sensor_without_publisher_fails_and_names_the_domain():
    found = judged(mocap=Stream())
    assert levels(found) == {'mocap/pose': 'fail'}
    assert 'ROS domain 5' in found['mocap/pose'].found


def paused():
    made = stream(100, 0.01)
    made.arrivals[200:] = [t + 0.15 for t in made.arrivals[200:]]
    return made


@pytest.mark.parametrize(('key', 'made', 'bad'), [
    ('mocap', stream(90, 0.01), {'mocap/pose rate': 'warn'}),
    ('mocap', stream(50, 0.01), {'mocap/pose rate': 'fail'}),
    ('mocap', stream(240, 0.01), {'mocap/pose rate': 'warn'}),
    ('mocap', paused(), {'mocap/pose pause': 'warn'}),
    ('battery', stream(50, 0.001), {})])
def test_rates_outside_their_limits_fail(key, made, bad):
    assert levels(judged(**{key: made})) == bad


@pytest.mark.parametrize(('age', 'jitter', 'level', 'words'), [
    (0.010, 0.004, 'ok', ''), (0.050, 0.001, 'warn', 'not synchronised'),
    (0.050, 0.100, 'warn', 'buffers'), (0.150, 0.300, 'fail', 'buffers'),
    (-0.020, 0.001, 'fail', 'not synchronised')])
def test_ages_distinguish_latency_from_a_clock_offset(age, jitter, level, words):
    finding = judged(mocap=stream(100, age, jitter))['mocap/pose age']
    assert finding.level == level and words in finding.remedy
    assert ('in the future' in finding.found) == (age < 0)


def test_one_early_stamp_reveals_a_clock_that_is_ahead():
    late = stream(200, 0.02, 0.001)
    late.ages[17] = -0.002
    assert levels(judged(imu=late)) == {'imu/data_raw age': 'fail'}


def test_wrong_units_duplicate_publishers_frozen_and_broken_messages_are_reported():
    in_g = judged(imu=stream(200, 0.001, size=1.0))
    assert levels(in_g) == {'imu/data_raw specific force': 'warn'}
    assert 'unit is g' in in_g['imu/data_raw specific force'].remedy
    twins = stream(100, 0.01)
    twins.publishers = ['sim_node', 'vrpn']
    assert levels(judged(mocap=twins)) == {'mocap/pose publishers': 'fail'}
    frozen = stream(100, 0.01)
    frozen.norms = [1.0] * len(frozen.norms)
    assert levels(judged(mocap=frozen)) == {'mocap/pose content': 'fail'}
    broken = stream(200, 0.001)
    broken.refused['specific force is not finite'] = 7
    found = judged(imu=broken)['imu/data_raw content']
    assert found.level == 'fail' and '7 of 600' in found.found


def status(level, text, values):
    return Diagnostic(0.0, '', level, text, values)


def running(state='ready', level=0):
    made = graph(joints=stream(200, 0.002))
    made.states['joint_bridge'] = state
    made.diagnostics = {
        'joint_bridge_node: gimbal1': status(level, 'overload', {'voltage': '11.9'}),
        'joint_bridge_node: inputs': status(2, 'command silent', {}),
        'rl_node: compute': status(1, '', {})}
    return made


def test_a_running_bridge_is_judged_by_its_reports():
    found = by_item(check_topics(running(level=2), ROBOT.gravity))
    assert levels(found) == {'joint_bridge gimbal1': 'fail'}
    assert found['joint_bridge gimbal1'].values == {'voltage': '11.9'}
    assert found['joint_states rate'].level == 'ok'
    for state, level in (('waiting: turn lost', 'warn'), ('lost: port away', 'fail')):
        found = by_item(check_topics(running(state), ROBOT.gravity))
        assert levels(found) == {'joint_bridge state': level}
        assert found['joint_bridge state'].found == state
