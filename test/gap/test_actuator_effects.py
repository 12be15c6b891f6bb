"""Effects of servos and rotors, simulated with small explicit steps, are recovered."""

from dataclasses import replace
from functools import cache

from flights import KEYS, model, Motion, P, ROBOT, solved, STEP
import numpy as np
import pytest

from beetle_omni_ros.identify.flights import engine as engine_module
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.keys import Entry, of_start, Prior
from beetle_omni_ros.identify.flights.quality import errors
from beetle_omni_ros.identify.flights.results import Weighed
from beetle_omni_ros.identify.flights.servo import (
    module_load,
    simulate,
    starts_of,
    undescribed_load,
    Windows,
)
from beetle_omni_ros.identify.flights.signals import Signals
from beetle_omni_ros.identify.flights.verdict import first_point, starts_in
from beetle_omni_ros.identify.recording.bag import COMMAND, JOINTS
from beetle_omni_ros.model.parameters import RobotParameters

MOTION = Motion(9, 12.0)
FINE = 2e-4
JOINT = ROBOT.joints


def steps(t):
    """(N, 4) commands that jump and drift [rad]."""
    rng = np.random.default_rng(3)
    jumps = rng.uniform(-0.6, 0.6, (30, 4))
    return jumps[np.minimum((t / 0.45).astype(int), 29)] + 0.2 * np.sin(7 * t)[:, None]


def flight(angles):
    """Readings of such joints; commands have the stamps of sending."""
    made = commanded(MOTION.flight().values[COMMAND][:, 4:])
    return replace(made, values=made.values | {JOINTS: angles})


def commanded(thrust):
    """Readings with these thrusts (N, 4) [N] and steps of the joints as commands."""
    made = MOTION.flight()
    return replace(made, times=made.times | {COMMAND: MOTION.t}, values=made.values | {
        COMMAND: np.concatenate([steps(MOTION.t), thrust], axis=1)})


CASES = [
    ({'delay': 0.030}, {'joint_command_latency.delay': 0.020}, None, 0.001),
    ({'delay': 0.025}, {'command_latency.delay': 0.015}, None, 0.001),
    ({'kp': 0.26, 'kd': 0.011}, {'joint_bandwidth.kp': 0.26, 'joint_bandwidth.kd': 0.011}, None,
     0.02),
    ({'speed': 4.0}, {'joint_velocity_limit.velocity_limit': 4.0},
     {'joint_velocity_limit.velocity_limit': np.log(0.5)}, 0.1),
    ({'coulomb': 0.008, 'stiction': 0.008}, {'joint_friction.coulomb': 0.008},
     {f'joint_friction.{name}': 0.006 for name in ('coulomb', 'stiction')}, 0.0012),
    ({'bend': 0.002}, {'joint_deflection.deflection_per_newton': 0.002}, None, 1e-4)]
SERVO = {'delay': 0.010, 'kp': JOINT.kp, 'kd': JOINT.kd, 'speed': JOINT.velocity_limit,
         'effort': JOINT.effort_limit, 'coulomb': 0.0, 'stiction': 0.0, 'bend': 0.0,
         'fading': 1e-3}
FLOWN = [*(case[0] for case in CASES), *({'coulomb': 0.007, 'stiction': 0.010, 'fading': fading}
         for fading in (0.03, 0.1)), {'effort': 0.05}, {'delay': 0.036},
         {'kp': 0.6, 'kd': 0.006}, {}]


def servo(**changes):
    """(N, 4) joint angles at 200 Hz of one of FLOWN."""
    return simulated()[:, FLOWN.index(changes)]


@cache
def simulated():
    """(N, len(FLOWN), 4) joint angles at 200 Hz, by explicit steps of 0.1 ms."""
    own = {name: np.array([[one.get(name, value)] for one in FLOWN])
           for name, value in SERVO.items()}
    kp, kd, speed, effort, coulomb, stiction = (own[name] for name in (
        'kp', 'kd', 'speed', 'effort', 'coulomb', 'stiction'))
    sent = MOTION.t
    commands, thrust = steps(sent), MOTION.thrust
    q, out = np.tile(commands[0], (len(FLOWN), 1)), []
    v = np.zeros_like(q)
    per = round(STEP / FINE)
    for k in range(len(sent) * per):
        if k % per == 0:
            out.append(q.copy())
        row = np.floor((k * FINE - own['delay'][:, 0]) / STEP + 1e-6).astype(int)
        target = commands[np.clip(row, 0, len(sent) - 1)] \
            + own['bend'] * thrust[min(k // per, len(thrust) - 1)]
        torque = np.clip(kp * (target - q) - kd * v, -effort, effort)
        still = np.abs(v) < 1e-3
        held = still & (np.abs(torque) < np.maximum(coulomb, stiction)) & (coulomb > 0)
        rubbing = coulomb + np.maximum(stiction - coulomb, 0.0) * np.exp(-(v / own['fading'])**2)
        torque = np.where(held, -v * JOINT.inertia / FINE, torque - rubbing * np.sign(
            np.where(still, torque, v)))
        v = np.clip(v + FINE * torque / JOINT.inertia, -speed, speed)
        q = q + FINE * v
    return np.array(out)


@pytest.mark.parametrize('true, expected, start, within', CASES,
                         ids=[next(iter(c[1])).partition('.')[0] for c in CASES])
def test_a_servo_effect_is_recovered_from_commands_and_encoders(true, expected, start, within):
    found = solved(model(flight(servo(**true))), list(expected), 'J', None, start, 6)
    for name, value in expected.items():
        assert KEYS[name].value(found[name]) == pytest.approx(value, abs=within)


def test_friction_also_acts_on_the_body_where_a_servo_model_gives_the_tilts():
    made, start = model(flight(servo(coulomb=0.008, stiction=0.008))), 'joint_friction@0'
    friction = {f'joint_friction.{name}': 0.008 for name in ('coulomb', 'stiction')}
    made.starts = {start: friction}
    assert not made.linear({}, [start]).slopes[:, :6].any()     # encoders give the tilts
    made.signals.reading_noise = 0.1
    made.settle({})
    slopes, expected = made.linear({}, [start]).slopes[:, :6, 0], []
    for theta in ({}, friction):        # twice, because the windows begin at the tilts before
        made.settle(theta)
        made.settle(theta)
        expected.append(made.residual(theta, 'B')['B'])
    change = (expected[1] - expected[0]).ravel()
    assert np.abs(change).max() > 0.01
    assert np.corrcoef(slopes.ravel(), change)[0, 1] > 0.95


@pytest.mark.parametrize('fading, start', [(0.03, 0.012), (0.1, 0.004)])
def test_stiction_is_found_from_below_and_from_above(fading, start):
    names = ['joint_friction.coulomb', 'joint_friction.stiction']
    flown = flight(servo(coulomb=0.007, stiction=0.010, fading=fading))
    found = solved(model(flown), names, 'J', None, dict(zip(names, (0.008, start))), 8)
    assert [found[name] for name in names] == pytest.approx([0.007, 0.010], abs=0.0015)


def lagged(tau, delay, most=99.0, k_asked=None):
    """(N, 4) thrusts at 200 Hz of commands held from their stamps, by steps of 0.1 ms."""
    per, out, f = round(STEP / FINE), [], k_asked[0].copy()
    for k in range(len(MOTION.t) * per):
        if k % per == 0:
            out.append(f.copy())
        row = int(np.clip(np.floor((k * FINE - delay) / STEP + 1e-6), 0, len(MOTION.t) - 1))
        f = f + FINE / tau * (np.minimum(k_asked[row], most) - f)
    return np.array(out)


@pytest.mark.parametrize('true, name, value, start', [
    ({'tau': 0.06, 'delay': 0.01}, 'rotor_lag.time_constant', 0.06, 0.0),
    ({'tau': 0.0942, 'delay': 0.022}, 'rotor_dead_time.delay', 0.012, 0.0),
    ({'tau': 0.0942, 'delay': 0.01, 'most': 9.0}, 'thrust_saturation.thrust_max', 9.0,
     np.log(9.5 / 20))])
def test_a_rotor_effect_is_recovered_from_the_thrust_that_results(true, name, value, start):
    asked = MOTION.thrust + 1.5 * np.sign(np.sin(5 * MOTION.t))[:, None]
    made = model(commanded(asked))
    truth = lagged(k_asked=asked, **true)
    rows = np.rint(made.signals.t / STEP).astype(int)
    x = start
    for _ in range(6):
        error = made.signals.thrust({name: x})[0] - truth[rows]
        slope = (made.signals.thrust({name: x + 1e-3})[0] - truth[rows] - error) / 1e-3
        x -= float((slope * error).sum() / (slope**2).sum())
    assert KEYS[name].value(x) == pytest.approx(value, rel=0.03)


def test_play_behind_the_encoder_turns_the_true_tilt_only():
    made = model(MOTION.flight())
    tight, loose = made.signals.joints({}), made.signals.joints({'joint_backlash.gap': 0.02})
    assert np.array_equal(tight[3], loose[3])
    apart = np.abs(tight[0] - loose[0])
    assert 0.008 < apart.max() < 0.011


def test_a_torque_limit_is_recovered_from_samples_at_the_limit():
    made, key = model(flight(servo(effort=0.05))), 'joint_torque_limit.effort_limit'
    begin = starts_of(KEYS[key], [made])
    tried = [start[0] for start in begin]
    rest = [np.square(made.residual(theta, 'J')['J']).mean()
            for theta in ({}, *({key: x} for x in tried))]
    # Every start has a derivative and is not at a bound; one fits better than no limit.
    assert all(x != rest[0] for x in rest[1:]) and min(rest[1:]) < rest[0]
    assert all(KEYS[key].value(x) > 0.003 for x in tried)
    found = solved(made, [key], 'J', None, {key: tried[int(np.argmin(rest[1:]))]}, 6)
    assert KEYS[key].value(found[key]) == pytest.approx(0.05, abs=0.003)


def engine_of(made, starts):
    """Engine of the joints of a flight with these starts, name -> key -> value."""
    made.starts = starts
    made.tangents = {f'{start}~{key}': (start, key) for start in starts for key in starts[start]}
    # four blocks; the forces of these readings are not those of the thrusts
    return Engine([made] * 4, dict.fromkeys(starts, Prior(0.03, 1.0, 0.0))
                  | dict.fromkeys(made.tangents, Prior(0.001, 0.3, 0.0)),
                  [Entry(of_start(start)[0], (start, *(f'{start}~{key}' for key in own)),
                         of_start(start)[1], False) for start, own in starts.items()],
                  dict.fromkeys(starts, (0.0, np.inf)),
                  curved=frozenset({*starts, *made.tangents}))


@pytest.mark.parametrize(('factor', 'rounds'), [(0.1, 6), (0.7, 6), (0.5, 1)])
def test_a_torque_limit_keeps_its_value_when_it_is_linearised_again(factor, rounds, monkeypatch):
    # with one round, the search ends far from where the limit acts
    monkeypatch.setattr(engine_module, 'MOST_ROUNDS', rounds)
    made, key = model(flight(servo(effort=0.05))), KEYS['joint_torque_limit.effort_limit']
    engine = engine_of(made, {'joint_torque_limit@0': {
        key.name: starts_of(key, [made])[0][0] + np.log(factor)}})
    solution = engine.run()
    assert solution.best == (0,)
    found = Weighed(engine, solution, KEYS, made.starts).effect(0, [0])
    stated = found['parameters']['effort_limit']
    assert stated['value'] == pytest.approx(0.05, rel=0.03)


def test_starts_that_are_not_named_do_not_act_in_the_flights_that_judge():
    engine = engine_of(model(flight(servo(coulomb=0.008, stiction=0.008))), {
        f'joint_friction@{k}': {'joint_friction.coulomb': size, 'joint_friction.stiction': size}
        for k, size in enumerate((0.003, 0.008, 0.02))})
    solution = engine.run()
    assert solution.best == (1,) and solution.theta[engine.index['joint_friction@2']] != 0
    assert errors(engine, solution, [1], engine.flights)['closure'] > 0.9


def one_servo(**changes):
    """A flight of which the third servo alone has these changes."""
    angles = servo().copy()
    angles[:, 2] = servo(**changes)[:, 2]
    return model(flight(angles))


def test_the_gains_of_one_servo_are_recovered():
    names = ['servo.kp[2]', 'servo.kd[2]', 'servo.kp[0]']
    found = solved(one_servo(kp=0.26, kd=0.011), names, 'J', None, None, 6)
    assert [KEYS[name].value(found[name]) for name in names] == pytest.approx(
        [0.26, 0.011, JOINT.kp], abs=0.02)


def test_values_do_not_move_when_they_are_linearised_again():
    names = 'servo.kp[2]', 'servo.kd[2]'
    engine = Engine([one_servo(kp=0.6, kd=0.006)] * 4, dict.fromkeys(names, Prior(0.03, 0.3, 0.0)),
                    [Entry('joint_bandwidth', names, 3, False)])
    solution = engine.run()
    assert solution.best == (0,)
    again = engine.again(solution, solution.best)
    deviation = np.sqrt(np.diag(again.posterior.covariance))
    assert (np.abs(again.theta[:2] - solution.theta[:2]) < 0.5 * deviation).all()


@pytest.mark.parametrize(('made', 'joint'), [
    (lambda: one_servo(coulomb=0.008, stiction=0.008), 3),
    (lambda: model(flight(servo(coulomb=0.008, stiction=0.008))), None)], ids=['one', 'all'])
def test_friction_of_one_servo_is_that_of_its_joint_and_friction_of_all_is_one_effect(made, joint):
    made = made()
    engine = engine_of(made, {name: own for name, own in starts_in(KEYS, [made]).items()
                              if of_start(name)[0] == 'joint_friction'})
    solution = engine.run()
    entry, = (engine.entries[k] for k in solution.best)
    assert (entry.name, entry.member) == ('joint_friction', joint)
    found = Weighed(engine, solution, KEYS, made.starts).effect(*solution.best, solution.best)
    assert found.get('joint') == joint
    assert found['parameters']['coulomb']['value'] == pytest.approx(0.008, abs=0.0012)


DESCRIBED = RobotParameters.load()


def test_undescribed_modules_load_joints_as_described_ones_of_equal_moment_and_inertia():
    flight, module = MOTION.flight(), DESCRIBED.multibody.module
    moment = -module.mass * module.centre_of_mass[2]
    inertia = module.inertia[0] - moment * module.centre_of_mass[2]
    expected = module_load(Signals(flight, DESCRIBED, P), {})
    hanging, turning = undescribed_load(Signals(flight, ROBOT, P), {})
    found = moment * hanging + inertia * turning
    assert np.std(found - expected) < 0.05 * np.std(expected)
    assert np.std(moment * hanging - expected) > np.std(found - expected)


@pytest.mark.parametrize('sets, base, moment', [
    ({'module_reaction.mass_moment': 2e-3}, 0.0, 2e-3), ({}, 1e-3, 1e-3),
    ({'module_reaction.mass_moment': -4e-4}, 1e-3, 6e-4)])
def test_a_servo_sags_under_a_module_that_hangs_beside_its_axis(sets, base, moment):
    k, gravity = 800, 9.8
    zero, one = np.zeros((k, 1, 4)), np.ones((k, 1, 4))
    windows = Windows(zero[0], zero[0], zero, zero, P.servo_step, 0, 8, (gravity * one, zero))
    robot = replace(ROBOT, effects={'module_reaction': {'module_inertia': 0.0,
                                                        'mass_moment': base}})
    shown = simulate(robot, windows, np.zeros((1, k, 1, 4)), [0], [sets], 0.0)[0, -1, 0]
    assert shown == pytest.approx(moment * gravity / ROBOT.joints.kp, rel=1e-3)


@pytest.mark.parametrize(('changes', 'late'), [({'effort': 0.05}, 0.0), ({'delay': 0.036}, 0.024)])
def test_flights_are_first_linearised_at_the_latency_of_their_servos(changes, late):
    made = model(flight(servo(**changes)))
    assert first_point([made], [made], ROBOT) == late
