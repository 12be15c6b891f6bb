"""Artificial bench logs: the published rotor map with the noise of a force-torque stand."""

import csv

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters

ROWS = RobotParameters.load().rotors.map
RATIO = 0.0165
HEADER = ('pwm_us', 'force_N', 'torque_N_m', 'voltage_V')


def bench(rng, count=200, force_noise=0.03, torque_noise=0.003, voltage_noise=0.04, sag=0.0):
    """(N, 4) pwm [us], force [N], torque [N m], voltage [V] of all five plateaus."""
    parts = []
    for row in ROWS:
        thrust = np.append(rng.uniform(0, row.thrust_max, count - 1), row.thrust_max)
        duty = np.polyval(row.coefficients[::-1], thrust / 10)
        stop = np.arange(8)
        thrust = np.concatenate([thrust, 0 * stop])
        duty = np.concatenate([duty, 50 + 0 * stop])
        noise = rng.normal(size=(3, len(thrust)))
        parts.append(np.stack([
            20 * duty, thrust + force_noise * noise[0],
            -RATIO * thrust + torque_noise * noise[1],
            row.voltage - sag * thrust / row.thrust_max + voltage_noise * noise[2]], axis=1))
    return np.concatenate(parts)


def write(path, rows, header=HEADER):
    """Write rows as a CSV file."""
    with open(path, 'w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[f'{value:.5f}' for value in row] for row in rows])
    return path
