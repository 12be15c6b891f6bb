"""
Margins of the controllers: how much of each defect they tolerate in flight, and linear margins.

    python benchmarks/margins.py --controllers nmpc,rl,rl_any --plants robot,measured

One quantity at a time is added to the plant; estimator and controller have the shipped robot file.
A flight tolerates it if every pose is reached, the mean U is at most 2 deg and the tilt commands
change by at most 0.02 rad (RMS) within 10 ms at the target. Bisection gives the largest tolerated
and the smallest other value. It assumes that every larger value is not tolerated either.

The linear margins are those of level hover, from the Jacobians of controller and robot, without
the supervisor, the estimator of the state and noise; `--plants ''` flies none. All flights take
half an hour of 16 cores.
"""

import argparse
from dataclasses import replace
import sys
from unittest.mock import patch

import joblib
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.latency import NoiseFilter
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.campaign import workers
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.effects import validated
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError

CHATTER, ANGLE = 0.02, 2.0      # [rad] of the tilt commands in 10 ms, [deg]: tolerated
PERIOD, HEIGHT, SEED = 0.01, 1.0, 5
SETTLING, EMPTY, LENGTH = 1000, 40, 300     # steps to the equilibrium, before and after an impulse
SIZE = 1e-3             # of an impulse [m, m/s, rad, rad/s, N]
PARTS = 'commands', 'tilts', 'thrusts'
FREQUENCIES = np.geomspace(0.05, 49.0, 3000)    # [Hz]


def delayed(name):
    """Return a function that gives a robot a delay effect [ms], on top of its own."""
    return lambda robot, ms: {name: {'delay': robot.effect(f'{name}.delay', 0.0) + ms / 1e3}}


def slower_servo(robot, part):
    """Servo bandwidth at a fraction, with the same damping ratio."""
    kp, kd = (np.broadcast_to(robot.effect(f'joint_bandwidth.{name}', getattr(robot.joints, name)),
                              4) for name in ('kp', 'kd'))
    return {'joint_bandwidth': {'kp': tuple(kp * part ** 2), 'kd': tuple(kd * part)}}


def thrust(robot, scale):
    """Thrust of all rotors for a command."""
    return {'thrust_coefficient': {'scale': scale}}


# Quantity -> effect, value without a change, largest change, resolution.
QUANTITIES = {
    'delay of commands [ms]': (delayed('command_latency'), 0.0, 64.0, 2.0),
    'delay of the IMU [ms]': (delayed('imu_filter_lag'), 0.0, 64.0, 2.0),
    'delay of the joints [ms]': (delayed('joint_feedback_delay'), 0.0, 128.0, 4.0),
    'delay of the MoCap [ms]': (delayed('mocap_time_offset'), 0.0, 128.0, 4.0),
    'servo bandwidth [1]': (slower_servo, 1.0, 0.2, 0.05),
    'lag of the rotors [ms]': (lambda robot, ms: {'rotor_lag': {
        'time_constant': robot.rotors.time_constant + ms / 1e3}}, 0.0, 192.0, 6.0),
    'more thrust [1]': (thrust, 1.0, 2.0, 0.07),
    'less thrust [1]': (thrust, 1.0, 0.36, 0.04)}


def tolerated(controller, plant, effects):
    """Whether a flight reaches all poses with little chatter and mean U."""
    task = make_task('random10', SEED)
    true = replace(plant, effects={**plant.effects, **validated(effects)})
    try:
        result = metrics(fly(controller, task, robot=RobotParameters.load(), plant=true,
                             seed=SEED), task)
    except RunError:        # no take-off
        return False
    return (all(pose['reached'] for pose in result['poses'])
            and result['hover_command_change_rms']['joint_rad'] <= CHATTER
            and result['mean']['U_orientation_deg'] <= ANGLE)


def margin(controller, plant, quantity):
    """Bisect one quantity of one controller on one plant; the text of the table."""
    effect, none, most, resolution = QUANTITIES[quantity]
    robot = RobotParameters.load(plant)

    def flies(value):
        return tolerated(controller, robot, effect(robot, value))

    if not flies(none):
        return '–'
    if flies(most):
        return f'> {most:g}' if most > none else f'< {most:g}'
    good, bad = none, most
    while abs(bad - good) > resolution:
        middle = (good + bad) / 2
        good, bad = (middle, bad) if flies(middle) else (good, middle)
    return f'{good:.4g} to {bad:.4g}'


def state_at(stamp, x, error, command):
    """State (25,) plus an error (16,) of position, velocity, turn, rate and tilts."""
    turn = Rotation.from_quat(x[model.QUATERNION]) * Rotation.from_rotvec(error[6:9])
    return State(stamp, x[model.POSITION] + error[:3], x[model.VELOCITY] + error[3:6],
                 turn.as_quat(), x[model.RATE] + error[9:12], x[model.TILT] + error[12:],
                 np.zeros(4), stamp - PERIOD, command)


def equilibrium(controller, advance, robot):
    """State (25,) and commands (8,) of level hover with this controller."""
    x = np.zeros(model.STATE_SIZE)
    x[2], x[9], x[model.THRUST] = HEIGHT, 1.0, robot.hover_thrust
    target = PoseTarget(np.array([0.0, 0.0, HEIGHT]), np.array([0.0, 0.0, 0.0, 1.0]))
    old, command = x, None
    controller.reset()
    for k in range(SETTLING):
        seen = x.copy()
        seen[model.TILT] = old[model.TILT]
        asked = controller.step(state_at(k * PERIOD, seen, np.zeros(16), command), target)
        acting = command or asked
        old, command = x, asked
        x = np.array(advance(x, np.r_[acting.tilt, acting.thrust], np.zeros(10), PERIOD)).ravel()
    return x, np.r_[command.tilt, command.thrust], target


def controller_response(controller, x, u, target):
    """(F, 8, 24) response of the commands to the errors of the state and to commands in force."""
    def run(impulse):
        controller.reset()
        made = []
        for k in range(EMPTY + LENGTH):
            given = impulse if k == EMPTY else np.zeros(24)
            command = controller.step(state_at(k * PERIOD, x, given[:16], Command(
                (k - 1) * PERIOD, *np.split(u + given[16:], 2))), target)
            made.append(np.r_[command.tilt, command.thrust])
        return np.array(made[EMPTY:])

    still = run(np.zeros(24))
    h = np.stack([(run(SIZE * unit) - still) / SIZE for unit in np.eye(24)], -1)
    w = 2j * np.pi * FREQUENCIES * PERIOD
    # what stays after the impulse is an integral
    return np.einsum('fk,kij->fij', np.exp(-np.outer(w, np.arange(LENGTH))), h - h[-1]) \
        + h[-1] / (1 - np.exp(-w))[:, None, None]


def robot_response(advance, x, u):
    """(F, 16, 8) response of the state to commands, which act one period later."""
    def step(error, more):
        turn = Rotation.from_quat(x[model.QUATERNION]) * Rotation.from_rotvec(error[6:9])
        moved = np.r_[x[:6] + error[:6], turn.as_quat(), x[10:] + error[9:]]
        after = np.array(advance(moved, u + more, np.zeros(10), PERIOD)).ravel()
        turned = Rotation.from_quat(x[model.QUATERNION]).inv() * Rotation.from_quat(after[6:10])
        return np.r_[after[:6] - x[:6], turned.as_rotvec(), after[10:] - x[10:]]

    size = 1e-5
    made = np.stack([(step(d[:24], d[24:]) - step(-d[:24], -d[24:])) / (2 * size)
                     for d in size * np.eye(32)], -1)
    z = np.exp(2j * np.pi * FREQUENCIES * PERIOD)[:, None, None]
    response = np.linalg.solve(z * np.eye(24) - made[:, :24], made[:, 24:] + 0 * z) / z
    return np.concatenate([response[:, :12], response[:, 12:16] / z], 1)    # encoders are late


def linear_margins(controller):
    """Margins of delay [ms], phase [deg] and gain [1] at hover: commands, tilts, thrusts."""
    robot = RobotParameters.load()
    flying, advance = registry.find(controller).make(robot), model.integrator(robot)
    x, u, target = equilibrium(flying, advance, robot)
    # alone, an impulse would be noise
    with patch.object(NoiseFilter, 'without', lambda self, error, step: error):
        c = controller_response(flying, x, u, target)
    w = 2 * np.pi * FREQUENCIES
    own = np.eye(8) - c[:, :, 16:] * np.exp(-1j * w * PERIOD)[:, None, None]
    loop = np.linalg.solve(own, c[:, :, :16] @ robot_response(advance, x, u))
    rows = {}
    for name, kept in zip(PARTS, (slice(0, 8), slice(0, 4), slice(4, 8))):
        part = loop[:, kept, kept]
        if name != 'commands':      # the loop of the others is closed
            rest = slice(4, 8) if name == 'tilts' else slice(0, 4)
            part = part + loop[:, kept, rest] @ np.linalg.solve(
                np.eye(4) - loop[:, rest, rest], loop[:, rest, kept])
        rows[name] = margins_of(part, w)
    return rows


def margins_of(loop, w):
    """Margins of I - loop by the eigenvalues of the loop (F, n, n), followed over frequency."""
    values = np.linalg.eigvals(loop)
    for k in range(1, len(values)):
        apart = np.abs(values[k - 1][:, None] - values[k])
        values[k] = values[k][linear_sum_assignment(apart)[1]]
    found: dict[str, list[float]] = {'delay_ms': [], 'phase_deg': [], 'gain': [], 'gain_down': []}
    size, angle = np.abs(values), np.angle(values) % (2 * np.pi)
    for k, i in np.argwhere((size[1:] > 1) != (size[:-1] > 1)):
        found['phase_deg'].append(np.degrees(angle[k, i]))
        found['delay_ms'].append(1e3 * angle[k, i] / w[k])
    crossed = (np.sign(values[1:].imag) != np.sign(values[:-1].imag)) & (values[1:].real > 0)
    for k, i in np.argwhere(crossed):
        found['gain' if size[k, i] < 1 else 'gain_down'].append(1 / size[k, i])
    return {name: float(max(rows) if name == 'gain_down' else min(rows)) if rows else None
            for name, rows in found.items()}


def main() -> None:
    """Fly, compute and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--controllers', default='nmpc,rl,rl_any')
    parser.add_argument('--plants', default='robot,measured')
    parser.add_argument('--jobs', type=int, default=-1)
    chosen = parser.parse_args()
    plants = {name: 'params/robot.yaml' if name == 'robot' else name
              for name in chosen.plants.split(',') if name}
    names = chosen.controllers.split(',')
    linear = [linear_margins(name) for name in names]
    cases = [(name, plant, quantity) for quantity in QUANTITIES for plant in plants.values()
             for name in names]
    console, shown = Console(width=None if sys.stdout.isatty() else 140), {}
    with workers(jobs=chosen.jobs):
        for case, text in zip(cases, joblib.Parallel(batch_size=1, return_as='generator')(
                joblib.delayed(margin)(*case) for case in cases), strict=True):
            shown[case] = text      # a run takes long: each result at once
            console.print(', '.join(case) + f': {text}', markup=False)
    table = Table('quantity', *(f'{name}, {plant}' for plant in plants for name in names))
    for quantity in QUANTITIES:
        table.add_row(quantity.replace('[', r'\['), *(
            text for case, text in shown.items() if case[-1] == quantity))
    if plants:
        console.print(table)
    table = Table('at hover', *(f'{name}, {part}' for name in names
                                for part in PARTS))
    for key in ('delay_ms', 'phase_deg', 'gain', 'gain_down'):
        table.add_row(key, *('–' if row[part][key] is None else f'{row[part][key]:.3g}'
                             for row in linear for part in PARTS))
    console.print(table)


if __name__ == '__main__':
    try:
        main()
    except ParameterError as error:
        sys.exit(f'margins.py: {error}')
