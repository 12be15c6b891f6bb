"""Artificial logs of a force-torque stand."""

import csv

import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters

ROWS = RobotParameters.load().rotors.map
RATIO = 0.0165
HEADER = ('pwm_us', 'force_N', 'torque_N_m', 'voltage_V')
PACKS = (22.2, 24.2, 26.2)
SURFACE = 0.2, 0.058        # thrust [N] over u and u^2, u = duty x voltage [V]
SERIES = ('t_s', 'target_thrust', 'force_z', 'torque_z', 'rpm', 'voltage')


def bench(rng, count=200, force_noise=0.03, torque_noise=0.003, voltage_noise=0.04):
    """(N, 4) pwm [us], force [N], torque [N m], voltage [V] of the five published voltages."""
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
            row.voltage + voltage_noise * noise[2]], axis=1))
    return np.concatenate(parts)


def stand(rng, noise=0.6, tare=0.0, drift=0.0):
    """(N, 6) as :func:`bench`, temperature and pack: steps of sagging packs, 5 rows each."""
    found = []
    for run, pack in enumerate(PACKS):
        for k, duty in enumerate(np.append(0.0, np.linspace(0.05, 0.8, 12))):
            voltage, heat = pack - 2.4 * duty, 40 + 3 * k + 12 * run
            thrust = np.polyval([*SURFACE[::-1], 0], duty * voltage) * (1 + drift * (heat - 66))
            running = duty > 0
            for noises in rng.normal(size=(5, 3)):
                found.append([1000 + 1000 * duty, thrust + running * noise * noises[0],
                              RATIO * thrust + tare + running * 0.02 * noises[1],
                              voltage + 0.01 * noises[2], heat, pack])
    return np.array(found)


def series(rng, up=0.07, down=0.045, dead=0.0, gains=(1.0,), noise=0.2):
    """(N, 6) of SERIES: six seconds at 100 Hz of steps, behind the lag; the gain may jump."""
    t = np.arange(600) / 100
    asked = rng.uniform(2, 10, 40)[(t / 0.3).astype(int)]
    static = asked * np.resize(gains, 12)[(t / 0.5).astype(int)]
    fine = np.arange(0, 6, 0.001)
    index = np.clip(((fine - dead + 1e-9) * 100).astype(int), 0, None)
    level, thrust = static[0], np.empty(len(fine))
    for k, goal in enumerate(static[index]):
        thrust[k] = level
        level += (goal - level) * -np.expm1(-0.001 / (up if goal > level else down))
    thrust = thrust[::10] + noise * rng.normal(size=600)
    return np.stack([t, asked, -thrust, -RATIO * thrust, 1000 * np.sqrt(np.abs(thrust)),
                     24.5 - 0.01 * thrust], axis=1)


def write(path, rows, header=HEADER):
    """Write rows as a CSV file."""
    with open(path, 'w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[f'{value:.5f}' for value in row] for row in rows])
    return path
