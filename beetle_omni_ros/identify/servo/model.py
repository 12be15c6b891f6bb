"""
Simulation of a tilt servo for many parameter sets at once.

    q'' = limit(wn^2 (q*(t - delay) + offset - q) - 2 zeta wn q') - wn^2 (load(q) + friction(q'))
    reading = play(q) + gain q + sine sin q + cosine cos q

The step is that of :mod:`beetle_omni_ros.model.servo` for an inertia of 1. A log without torque
determines only ratios to the stiffness Kp, so friction, load and torque limit are angles: the
position error at which the servo has this torque.
"""

from collections.abc import Callable
import ctypes
from dataclasses import dataclass
from functools import cache
import logging

import casadi as ca
import numpy as np

from beetle_omni_ros.identify.inference.hierarchy import Spread
from beetle_omni_ros.identify.servo.log import JointLog
from beetle_omni_ros.model.effects import delaying, per_joint
from beetle_omni_ros.model.native import built, EXACT, generated
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import load_yaml, RunError
from beetle_omni_ros.model.servo import CASADI, play, Servo, Step

LONGEST_STEP = 0.0025   # [s]; relative error of the frequency (wn step)^2 / 24: 0.3 % at 100 rad/s
NEVER = 1e3             # value of a limit without effect


@dataclass(frozen=True)
class Term:
    """
    One parameter of a parameter set.

    Attributes:
        unit: unit of its value.
        off: value without effect.
        low: smallest value of a fit.
        high: largest value of a fit.
        scale: relevant change; of the logarithm if ``logarithmic``.
        spread: prior standard deviations about the robot file.
        logarithmic: whether its logarithm is fitted.
        words: name in a sentence; default its name.
        in_step: whether it is in the integration step, not before (delay, offset) or after it
            (play).

    """

    unit: str
    off: float
    low: float
    high: float
    scale: float
    spread: Spread
    logarithmic: bool = False
    words: str = ''
    in_step: bool = True


# The spreads are prior standard deviations about the robot file: of the common value, of each
# joint, of each log, of each joint in each log; of logarithms where the term is logarithmic.
# Servos of one type differ by 10 to 15 %, and their delays on one bus by 2 ms.
TERMS = {
    # sqrt(Kp / J) and Kd / (2 sqrt(Kp J))
    'natural_frequency': Term('rad/s', 60.0, 8.0, 400.0, 0.05, Spread(0.5, {'joint': 0.15}), True,
                              'bandwidth'),
    'damping_ratio': Term('1', 0.9, 0.05, 20.0, 0.05, Spread(0.5, {'joint': 0.15}), True,
                          'damping'),
    'delay': Term('s', 0.0, 0.0, 0.12, 0.002, Spread(0.02, {'joint': 0.002, 'log': 0.01}),
                  in_step=False),
    # measured minus commanded
    'offset': Term('rad', 0.0, -0.5, 0.5, 0.002, Spread(0.0, {'joint': 0.02, 'unit': 0.01}),
                   in_step=False),
    # half a dead band, and the breakaway above that
    'coulomb_friction': Term('rad', 0.0, 0.0, 0.4, 0.002,
                             Spread(0.02, {'joint': 0.01, 'unit': 0.004}), words='friction'),
    'stiction': Term('rad', 0.0, 0.0, 0.4, 0.002, Spread(0.01, {})),
    # play to each side, before the encoder
    'backlash': Term('rad', 0.0, 0.0, 0.3, 0.002, Spread(0.02, {'joint': 0.01}), words='play',
                     in_step=False),
    'velocity_limit': Term('rad/s', NEVER, 0.2, NEVER, 0.05, Spread(1.0, {}), True,
                           'speed limit'),
    'torque_limit': Term('rad', NEVER, 0.005, NEVER, 0.05, Spread(1.0, {}), True,
                         'torque limit (an error of position)'),
    # deflection ~ sin(q + phase): a weight on the joint
    'load_sine': Term('rad', 0.0, -0.3, 0.3, 0.002, Spread(0.02, {'joint': 0.01}),
                      words='load (sine)'),
    'load_cosine': Term('rad', 0.0, -0.3, 0.3, 0.002, Spread(0.02, {'joint': 0.01}),
                        words='load (cosine)'),
    # Errors of the reading: gain q + sine sin q + cosine (cos q - 1). The harmonics are those of
    # an encoder whose axis is off the joint's.
    'encoder_gain': Term('1', 0.0, -0.3, 0.3, 0.002, Spread(0.0, {'joint': 0.02}),
                         words='gain of the reading', in_step=False),
    'encoder_sine': Term('rad', 0.0, -0.3, 0.3, 0.002, Spread(0.0, {'joint': 0.02}),
                         in_step=False),
    'encoder_cosine': Term('rad', 0.0, -0.3, 0.3, 0.002, Spread(0.0, {'joint': 0.02}),
                           in_step=False),
}
NAMES = tuple(TERMS)
INDEX = {name: k for k, name in enumerate(NAMES)}
READING_ERRORS: dict[str, Callable] = {'encoder_gain': lambda q: q, 'encoder_sine': np.sin,
                  'encoder_cosine': lambda q: np.cos(q) - 1}
OFF = np.array([term.off for term in TERMS.values()])
STEP_TERMS = tuple(name for name, term in TERMS.items() if term.in_step)
# Entry -> the terms that it changes; of the catalogue, but for the gain and the load.
ENTRIES = {
    'reading_gain': ('encoder_gain',),
    'joint_bandwidth': ('natural_frequency', 'damping_ratio'),
    'joint_command_latency': ('delay',),
    'joint_friction': ('coulomb_friction', 'stiction'),
    'joint_backlash': ('backlash',),
    'joint_offset': ('offset',),
    'joint_encoder_error': ('encoder_gain', 'encoder_sine', 'encoder_cosine'),
    'joint_load': ('load_sine', 'load_cosine'),
    'joint_velocity_limit': ('velocity_limit',),
    'joint_torque_limit': ('torque_limit',),
}
LIMITS = tuple(name for name in ENTRIES if name.endswith('_limit'))
JOINTS = 4
# Delays that a log does not separate from that of the entry above.
OTHER_DELAYS = tuple(name for name in delaying('tilt', 'encoders') if name not in ENTRIES)
# Arrays (steps, sets), states (steps + 1, sets), numbers (NUMBERS, sets).
LOOP = """
void servo_run(long steps, long sets, double step, const double *command, const double *numbers,
         double *middle, double *velocity) {
    const double *arguments[ARGUMENTS];
    double *results[RESULTS], work[WORK];
    for (long at = 0; at < steps * sets; at++) {
        arguments[0] = command + at;
        arguments[1] = middle + at;
        arguments[2] = velocity + at;
        arguments[3] = &step;
        for (long k = 0; k < NUMBERS; k++)
            arguments[4 + k] = numbers + k * sets + at % sets;
        results[0] = middle + at + sets;
        results[1] = velocity + at + sets;
        servo_step(arguments, results, 0, work, 0);
    }
}
"""


def simulate(log: JointLog, joint: np.ndarray | int, sets: np.ndarray,
             held: bool = True) -> np.ndarray:
    """
    Simulation over a whole log, from its first position and velocity.

    Leapfrog steps with implicit damping and friction, so that static friction holds a joint
    exactly.

    Args:
        log: commands, times and initial state.
        joint: (B,) index of the log's joint for each set, or one for all.
        sets: (B, len(NAMES)) parameter sets.
        held: whether a command acts until the next sample; else it is interpolated.

    Returns:
        (B, N) positions at the log's times of readings, or of rows without one [rad].

    """
    sets = np.atleast_2d(sets)
    joint = np.broadcast_to(joint, len(sets))
    step = log.period / max(1, int(np.ceil(log.period / LONGEST_STEP - 1e-9)))
    times = np.maximum(np.where(log.fresh, log.read_t, log.t), log.t[0])
    count = int(np.ceil((times.max() - log.t[0]) / step - 1e-6))
    value = dict(zip(NAMES, sets.T, strict=True))
    command = _commands(log, joint, value['delay'], log.t[0] + step * np.arange(count + 1), held)
    positions = _integrate(value, command + value['offset'], log.start[:, joint], step)
    return with_encoder_errors(_at_samples(positions, (times - log.t[0]) / step), value)


def with_encoder_errors(positions: np.ndarray, value: dict[str, np.ndarray]) -> np.ndarray:
    """Readings (B, N) [rad] of the ``encoder_...`` terms (B,) at positions (B, N)."""
    shown = positions
    for name, shape in READING_ERRORS.items():
        if value[name].any():
            shown = shown + value[name][:, None] * shape(positions)
    return shown


def _commands(log, joint, delay, edges, held):
    """Means (K, B) of delayed commands over steps, computed once for equal delays."""
    keys, which = np.unique(np.stack([joint, delay]), axis=1, return_inverse=True)
    middle = (edges[1:] + edges[:-1]) / 2
    means = [log.held_command(int(j), edges - d) if held else log.command_at(int(j), middle - d)
             for j, d in keys.T]
    return np.stack(means, axis=1)[:, which.ravel()]


def _integrate(value, command, start, step):
    """Positions (K + 1, B) of held commands (K, B) from positions and velocities (2, B)."""
    # Leapfrog: positions are half a step ahead of velocities.
    (q, v), count = start, command.shape[1]
    middle, velocity = np.empty((2, len(command) + 1, count))
    middle[0], velocity[0] = q + 0.5 * step * v, v
    numbers = np.ascontiguousarray([value[name] for name in STEP_TERMS])
    if (run := _compiled()) is not None:
        run(*command.shape, step, np.ascontiguousarray(command), numbers, middle, velocity)
    else:
        advance = _advance().map(count)
        for k, target in enumerate(command):
            middle[k + 1], velocity[k + 1] = (moved.full().ravel() for moved in advance(
                *(row[None] for row in (target, middle[k], velocity[k], np.full(count, step),
                                        *numbers))))
    positions = middle - 0.5 * step * velocity
    return play(positions, value['backlash']) if value['backlash'].any() else positions


@cache
def _advance() -> ca.Function:
    """One step: command, position, velocity, step and ``STEP_TERMS`` -> position, velocity."""
    target, here, before, step = (ca.SX.sym(name) for name in (
        'target', 'here', 'before', 'step'))
    value = {name: ca.SX.sym(name) for name in STEP_TERMS}
    stiffness = value['natural_frequency']**2
    coulomb, above, sine, cosine, torque = (value[name] * stiffness for name in (
        'coulomb_friction', 'stiction', 'load_sine', 'load_cosine', 'torque_limit'))
    move = Step(CASADI, Servo(
        1.0, stiffness, 2 * value['damping_ratio'] * value['natural_frequency'],
        value['velocity_limit'], torque, coulomb=coulomb, stiction=coulomb + above), step)
    after = move.kick(target, here, before, -sine * ca.sin(here) - cosine * (ca.cos(here) - 1))
    return ca.Function('servo_step', [target, here, before, step, *value.values()],
                       [here + step * after, after])


@cache
def _compiled() -> Callable | None:
    """All steps of all sets in C; None without a compiler, then they are evaluated one by one."""
    advance = _advance()
    sizes = {'ARGUMENTS': advance.sz_arg(), 'RESULTS': advance.sz_res(),
             'WORK': max(advance.sz_w(), 1), 'NUMBERS': len(STEP_TERMS)}
    source = '\n'.join([generated([advance]), *(
        f'#define {name} {size}' for name, size in sizes.items()), LOOP])
    try:
        run = ctypes.CDLL(str(built('servo', source, EXACT))).servo_run
    except (RunError, OSError) as error:
        logging.getLogger(__name__).info('servos move without C: %s', str(error).splitlines()[0])
        return None
    array = np.ctypeslib.ndpointer(float, flags='C_CONTIGUOUS')
    run.restype, run.argtypes = None, [ctypes.c_long, ctypes.c_long, ctypes.c_double, *[array] * 4]
    return run


def _at_samples(positions, places):
    """(B, N) from (K + 1, B) at fractional indices (N,)."""
    low = np.minimum(places.astype(int), len(positions) - 2)
    part = places - low
    near = np.rint(places).astype(int)
    if np.abs(places - near).max() < 0.02:      # even sampling: nothing to interpolate
        return np.ascontiguousarray(positions[near].T)
    return ((1 - part)[:, None] * positions[low] + part[:, None] * positions[low + 1]).T


def own_delay() -> float:
    """Delay [s] from a command to its reading that the simulator has for every robot."""
    simulator = load_yaml(share_path('params/simulator.yaml'))
    return simulator['command_delay'] + simulator['encoder_latency']


def other_delays(robot: RobotParameters) -> float:
    """Sum of the file's ``OTHER_DELAYS`` [s]."""
    return sum(robot.effects.get(name, {}).get('delay', 0.0) for name in OTHER_DELAYS)


def held(robot: RobotParameters) -> bool:
    """Whether the file's servos hold a command until the next one."""
    # The published gains come from a replay with interpolated commands; others hold for held ones.
    return any(name in robot.effects for name in (*ENTRIES, *OTHER_DELAYS))


def file_sets(robot: RobotParameters, flown: bool = False) -> np.ndarray:
    """
    Parameter sets (4, P) of the servos of a robot file with effects.

    Their delay is that of the simulator and of the file. The published servos have none unless
    ``flown``, because their gains come from a replay without it.

    Sign of the zero: the true tilt is the encoder's plus ``joint_offset``. A servo at rest has the
    commanded true tilt, so its encoder reads the command minus ``joint_offset``. Deflection is not
    included, because it needs a thrust.
    """
    joint, effects = robot.joints, robot.effects
    sets = np.tile(OFF, (JOINTS, 1))
    friction = effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
    encoder = effects.get('joint_encoder_error', {})
    for j in range(JOINTS):
        kp, kd = joint.of(j).kp, joint.of(j).kd
        coulomb, stiction = (per_joint(friction[name], j) for name in ('coulomb', 'stiction'))
        values = {
            'natural_frequency': np.sqrt(kp / joint.inertia),
            'damping_ratio': kd / (2 * np.sqrt(kp * joint.inertia)),
            'delay': effects.get('joint_command_latency', {}).get('delay', 0.0)
            + other_delays(robot) + (own_delay() if flown or held(robot) else 0.0),
            'offset': -effects.get('joint_offset', {}).get('offset', (0.0,) * JOINTS)[j],
            'coulomb_friction': coulomb / kp, 'stiction': max(stiction - coulomb, 0.0) / kp,
            'backlash': per_joint(effects.get('joint_backlash', {}).get('gap', 0.0), j) / 2,
            'velocity_limit': joint.velocity_limit, 'torque_limit': joint.effort_limit / kp,
            **{f'encoder_{name}': encoder[name][j] for name in encoder}}
        for name, value in values.items():
            sets[j, INDEX[name]] = np.clip(value, TERMS[name].low, TERMS[name].high)
    return sets


def catalogue_values(values: np.ndarray, robot: RobotParameters) -> dict[str, dict[str, float]]:
    """
    Parameters of the catalogue's joint entries for one parameter set (P,).

    Friction and torque limit of a log are position errors; times the stiffness they are torques.
    """
    value = dict(zip(NAMES, values, strict=True))
    kp = robot.joints.inertia * value['natural_frequency']**2
    band = value['coulomb_friction']
    return {
        'joint_bandwidth': {
            'kp': kp, 'kd': 2 * value['damping_ratio'] * kp / value['natural_frequency']},
        'joint_command_latency': {
            'delay': value['delay'] - other_delays(robot) - own_delay()},
        'joint_friction': {'coulomb': kp * band, 'stiction': kp * (band + value['stiction'])},
        # A log shows the play before the encoder only.
        'joint_backlash': {'gap': 2 * value['backlash'], 'at_encoder': 1.0},
        'joint_offset': {'offset': -value['offset']},
        'joint_encoder_error': {name: value[f'encoder_{name}']
                                for name in ('gain', 'sine', 'cosine')},
        'joint_velocity_limit': {'velocity_limit': value['velocity_limit']},
        'joint_torque_limit': {'effort_limit': kp * value['torque_limit']}}
