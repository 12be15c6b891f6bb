"""Faults of the simulated robot: each has its stated effect at its time only."""

from dataclasses import MISSING
from pathlib import Path

import numpy as np
import pytest
from sim_robots import HIGH, ROBOT, WORLD

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim import sensors
from beetle_omni_ros.sim import simulator as whole
from beetle_omni_ros.sim.fault_kinds import KINDS
from beetle_omni_ros.sim.faults import (
    Fault,
    load_cases,
    load_faults,
    OF_PROCESSES,
    parse_faults,
    READINGS,
)
from beetle_omni_ros.sim.simulator import Simulator

HOVER = np.full(4, ROBOT.hover_thrust)
# A value for each number that has no default.
GIVEN = {'rotor': 2, 'servo': 3, 'share': 0.5, 'time_constant': 0.1, 'rate': 1.0, 'angle': 0.5,
         'delay': 0.03, 'period': 0.1, 'step': 0.5, 'axis': 5, 'charge': 0.3, 'resistance': 0.2,
         'mass': 0.5, 'mocap_jumps': {'x': 1.0}, 'mocap_turned': {'yaw': 1.0},
         'mocap_noisy': {'position': 0.1, 'orientation': 0.1}, 'gyroscope_bias': {'y': 0.3},
         'accelerometer_bias': {'z': 1.0}, 'imu_saturated': {'specific_force': 1.0},
         'imu_spikes': {'specific_force': 50.0, 'period': 0.01}, 'push': {'x': 30.0},
         'servo_jammed': {'offset': 0.5}}


def some(kind, **times):
    """A fault of a kind with a measurable effect."""
    numbers = {key: GIVEN[key] for key, number in KINDS[kind].numbers.items()
               if number.default is MISSING}
    return Fault(kind, **{**numbers, **GIVEN.get(kind, {}), **times})


def flight(*faults, ticks=160, seed=3, conditions='nominal'):
    """Frames of a flight whose joints and rotors move, with these faults."""
    simulator = Simulator(ROBOT, WORLD, conditions, seed=seed)
    simulator.reset(HIGH)
    simulator.set_faults(faults)
    frames = []
    for k in range(ticks):
        if k % 2 == 0:
            wave = np.sin(0.15 * k + np.arange(4))
            simulator.command(Command(simulator.time, 0.6 * wave, HOVER + 2 * wave))
        frames.append(simulator.step())
    return frames, simulator


def flat(reading):
    """All numbers of a reading; () for None."""
    if reading is None:
        return ()
    values = [getattr(reading, name) for name in reading.__slots__ if name != 'names']
    return np.concatenate([np.ravel(value) for value in values if value is not None])


def differing(frames, others, start=0):
    """Names of readings that differ after ``start`` ticks, and 'truth'."""
    found = set()
    for one, other in zip(frames[start:], others[start:], strict=True):
        for name in READINGS:
            if not np.array_equal(flat(getattr(one, name)), flat(getattr(other, name)),
                                  equal_nan=True):
                found.add(name)
        if not np.array_equal(one.truth.position, other.truth.position) \
                or not np.array_equal(one.truth.tilt, other.truth.tilt):
            found.add('truth')
    return found


ROBOT_KINDS = sorted(name for name, kind in KINDS.items()
                     if OF_PROCESSES.isdisjoint(kind.functions))
SENSING = {name: kind.functions.keys() & set(READINGS) for name, kind in KINDS.items()}
PHYSICAL = {name for name in ROBOT_KINDS
            if KINDS[name].functions.keys() & {'drive', 'command', 'wrench', 'payload'}}


@pytest.fixture(scope='module')
def healthy():
    return flight()[0]


@pytest.mark.parametrize('kind', ROBOT_KINDS)
def test_a_fault_kind_changes_its_quantity_from_its_start_and_a_sensor_fault_to_its_end(
        kind, healthy):
    ends = {} if kind in PHYSICAL or not SENSING[kind] else {'duration': 0.2}
    frames, simulator = flight(some(kind, at=0.2, **ends))
    assert differing(frames[:40], healthy[:40]) == set()
    changed = differing(frames, healthy, 40)
    if ends:
        assert differing(frames, healthy, 130) == set() and simulator.faults == []
    if kind in PHYSICAL:
        assert 'truth' in changed
    elif kind.startswith('battery_') and kind != 'battery_unread':
        assert 'battery' in changed
    else:
        assert changed == SENSING[kind]


def test_rotor_speeds_come_at_50_hz_and_are_those_of_the_thrust():
    frames, _ = flight(ticks=400)
    readings = [frame.rotors for frame in frames if frame.rotors is not None]
    stamps = [reading.stamp for reading in readings]
    np.testing.assert_allclose(np.diff(stamps), 0.02, atol=1e-9)
    late = [frame.time - frame.rotors.stamp for frame in frames if frame.rotors is not None]
    np.testing.assert_allclose(late, sensors.ROTOR_LATENCY, atol=1e-9)
    thrust = {round(frame.time, 6): frame.truth.thrust for frame in frames}
    rpm = sensors.RPM_AT_1_NEWTON
    errors = [reading.speed / (rpm * np.pi / 30 * np.sqrt(thrust[round(reading.stamp, 6)])) - 1
              for reading in readings[5:]]
    assert 0.5 < np.std(errors) / sensors.ROTOR_NOISE < 1.5


def test_a_propeller_that_breaks_changes_no_speed():
    share, (intact, _) = 0.5, flight(ticks=300)
    broken, _ = flight(Fault('propeller_broken', at=0.5, rotor=1, share=share, duration=0.5),
                       ticks=300)
    speeds = [np.array([frame.rotors.speed[0] for frame in frames if frame.rotors is not None])
              for frames in (intact, broken)]
    np.testing.assert_allclose(*speeds, rtol=0.1)
    assert min(frame.truth.thrust[0] for frame in broken[150:200]) \
        < 1.1 * share * min(frame.truth.thrust[0] for frame in intact[150:200])


def test_a_jammed_joint_slips_at_its_rate_and_then_holds():
    frames, _ = flight(Fault('servo_jammed', at=0.2, servo=2, offset=0.8), ticks=200)
    tilt = np.array([frame.truth.tilt[1] for frame in frames])
    assert np.isclose(tilt[120], tilt[39] + 0.8, atol=0.02)
    assert np.ptp(tilt[100:]) < 0.005
    assert np.abs(np.diff(tilt[39:])).max() < 1.3 * 10 * 0.005


def test_a_servo_regulates_by_its_shifted_encoder():
    simulator = Simulator(ROBOT, WORLD)
    simulator.reset(HIGH)
    simulator.set_faults([Fault('encoder_shifted', servo=1, angle=1.5)])
    for _ in range(200):
        simulator.command(Command(simulator.time, np.full(4, 0.4), np.zeros(4)))
        frame = simulator.step()
    np.testing.assert_allclose(frame.truth.tilt, [-1.1, 0.4, 0.4, 0.4], atol=0.01)
    np.testing.assert_allclose(frame.joints.position, 0.4, atol=0.01)


def test_a_turn_of_the_markers_is_in_base_link(healthy):
    frames, _ = flight(Fault('mocap_turned', roll=np.pi / 2))
    for frame, other in zip(frames, healthy, strict=True):
        if frame.mocap is not None:
            turned = rotations.multiply(other.mocap.quaternion,
                                        rotations.from_rpy(np.pi / 2, 0, 0))
            np.testing.assert_allclose(frame.mocap.quaternion, turned, atol=1e-12)


def test_faults_that_stay_in_the_list_continue():
    simulator = Simulator(ROBOT, WORLD)
    simulator.reset(HIGH)
    slip = Fault('servo_jammed', servo=1, offset=0.5)
    simulator.set_faults([slip])
    for _ in range(60):
        simulator.step()
    simulator.set_faults([slip, Fault('imu_lost')])
    for _ in range(60):
        frame = simulator.step()
    assert np.isclose(frame.truth.tilt[0], 0.5, atol=0.01)
    assert simulator.faults == ['servo_jammed', 'imu_lost']
    simulator.set_faults([])
    simulator.step()
    assert simulator.faults == []


# Crashes ---------------------------------------------------------------------------------------

def fallen(height, quaternion=(0, 0, 0, 1)):
    simulator = Simulator(ROBOT, WORLD)
    simulator.reset([0, 0, height], quaternion)
    for _ in range(400):
        simulator.step()
    return simulator


def test_the_impact_of_a_fall_has_its_speed():
    simulator = fallen(2.16)
    impact = simulator.truth.impact
    drop = 2.16 - WORLD.foot_depth
    assert np.isclose(impact.speed, np.sqrt(2 * ROBOT.gravity * drop), rtol=0.03)
    assert impact.inclination < 0.05
    assert simulator.truth.broken


def test_a_robot_on_its_side_breaks_unless_placed_there():
    side = rotations.from_rpy(np.pi / 2, 0, 0)
    assert fallen(0.9, side).truth.broken
    assert not fallen(0.33, side).truth.broken


def test_a_broken_robot_stays_down_until_reset():
    simulator = fallen(2.0)
    for _ in range(200):
        simulator.command(Command(simulator.time, np.zeros(4), np.full(4, 15.0)))
        frame = simulator.step()
    assert frame.truth.position[2] < 0.4 and frame.truth.thrust.max() < 0.1
    assert frame.truth.broken
    simulator.reset()
    assert not simulator.truth.broken and simulator.truth.impact is None
    for _ in range(100):
        simulator.command(Command(simulator.time, np.zeros(4), np.full(4, 15.0)))
        frame = simulator.step()
    assert frame.truth.position[2] > 0.3


def test_a_soft_touchdown_breaks_nothing(monkeypatch):
    monkeypatch.setattr(whole, 'AIRBORNE_TIME', 0.05)
    simulator = Simulator(ROBOT, WORLD)
    simulator.reset([0, 0, WORLD.foot_depth + 0.03])
    for _ in range(200):
        simulator.step()
    assert 0.5 < simulator.truth.impact.speed < 1.0
    assert not simulator.truth.broken


# Declarations ----------------------------------------------------------------------------------


@pytest.mark.parametrize(('numbers', 'named'), [
    ({'rotor': 5}, '1 to 4'), ({'rotor': 1.5}, 'an integer'),
    ({'rotor': 1, 'servo': 1}, "'servo': unknown key")])
def test_numbers_are_checked_by_name(numbers, named):
    with pytest.raises(ParameterError, match=named):
        Fault('rotor_stops', **numbers)


def test_the_shipped_list_and_the_page_contain_every_kind():
    flown = {fault.kind for case in load_cases().values() for fault in case.strike}
    rows = (Path(__file__).parents[2] / 'docs' / 'faults.md').read_text().splitlines()
    described = {row.split('`')[1] for row in rows if row.startswith('| `')}
    assert flown == set(KINDS) <= described


def test_a_file_is_a_list_of_cases_and_the_faults_of_one_flight(tmp_path):
    path = tmp_path / 'faults.yaml'
    path.write_text('faults:\n  two: {strike: [{kind: rotor_stops, at: 3, duration: 2, rotor: 2}, '
                    '{kind: joints_lost}]}\n  last: {expected: lands, what: no pose, '
                    'strike: [{kind: mocap_lost}]}\n')
    two, last = load_cases(path).values()
    assert two.strike == (Fault('rotor_stops', 3.0, 2.0, rotor=2), Fault('joints_lost'))
    assert (two.expected, last.expected, last.what) == ('flies_on', 'lands', 'no pose')
    assert load_faults(path) == [*two.strike, *last.strike]


def test_short_texts_describe_a_fault():
    assert parse_faults(' rotor_stops rotor=2;mocap_lost duration=3 ; ') == [
        Fault('rotor_stops', rotor=2), Fault('mocap_lost', duration=3)]
    assert parse_faults('') == []
    for case in load_cases().values():
        assert parse_faults('; '.join(map(str, case.strike))) == list(case.strike)
    for text in ('rotor_stops 2', 'rotor_stops rotor=x', 'nothing'):
        with pytest.raises(ParameterError, match='faults'):
            parse_faults(text)
