"""Artificial response logs: an independent simulation of a servo, sampled like a real log."""

import csv
from functools import cache

import numpy as np

from beetle_omni_ros.identify.servo.log import JointLog

STEP = 1e-4                        # [s] of the simulation, plain semi-implicit Euler
COUNT = 2 * np.pi / 4096           # [rad] of the encoder
FADING = 0.05                      # [rad/s] over which stiction falls to sliding friction


def sweep(duration=10.0, periods=(1.8, 2.6), amplitudes=(1.0, 1.7), rate=100.0):
    """Times (N,) [s] and a sine whose period and amplitude vary slowly (N,) [rad]."""
    t = np.arange(0.0, duration, 1 / rate)
    part = t / duration
    period = periods[0] + (periods[1] - periods[0]) * part
    amplitude = amplitudes[0] + (amplitudes[1] - amplitudes[0]) * part
    phase = np.cumsum(2 * np.pi / period) / rate
    return t, amplitude * np.sin(phase)


def trapezoid(phase, travel=3.5, speed=7.0, hold=1.0, duration=3.7, rate=200.0):
    """Times (N,) [s] and ramps with holds (N,) [rad], from ``phase`` [s] after a ramp's start."""
    t, ramp = np.arange(0.0, duration, 1 / rate), travel / speed
    corners = np.cumsum([0.0, ramp, hold, ramp, hold])
    return t, np.interp((t + phase) % corners[-1], corners,
                        travel * np.array([-0.5, 0.5, 0.5, -0.5, -0.5]))


def servo(t, command, **values):
    """Positions (N,) [rad] of :func:`_moved`; most logs differ in the noise alone."""
    return _moved(t.tobytes(), command.tobytes(), **values)


@cache
def _moved(t, command, *, frequency=47.0, damping=0.63, delay=0.015, coulomb=0.0, stiction=0.0,
          backlash=0.0, velocity_limit=np.inf, torque_limit=np.inf, offset=0.0, gain=0.0,
          cosine=0.0, rough=0.0):
    """Positions (N,) [rad] of a servo that holds each command from its logged time on."""
    t, command = np.frombuffer(t), np.frombuffer(command)
    # It has been moving before the log: a straight run-up of a second.
    lead = np.arange(-1.0, 0.0, t[1] - t[0])
    first = command[0] + (command[1] - command[0]) / (t[1] - t[0]) * lead
    count, t = len(t), np.concatenate([t[0] + lead, t])
    command = np.concatenate([first, command])
    fine = np.arange(t[0], t[-1] + STEP, STEP)
    index = np.searchsorted(t, fine - delay + 1e-9, side='right') - 1
    slope = (command[1] - command[0]) / (t[1] - t[0])
    held = np.where(index >= 0, command[np.maximum(index, 0)],
                    command[0] + slope * (np.floor((fine - delay - t[0]) / (t[1] - t[0]))
                                          * (t[1] - t[0])))
    q, v, shown = held[0] + offset, slope, held[0] + offset
    positions = np.empty(len(fine))
    for k, wanted in enumerate(held.tolist()):
        positions[k] = shown
        # the limit is that of the motor's torque, which also brakes
        push = frequency**2 * (wanted + offset - q) - 2 * damping * frequency * v
        v += STEP * min(max(push, -frequency**2 * torque_limit), frequency**2 * torque_limit)
        here = coulomb * (1 + rough * np.sin(3 * q)) if rough else coulomb
        grip = STEP * frequency**2 * (here + stiction * np.exp(-(v / FADING)**2)
                                      if stiction else here)
        v = 0.0 if abs(v) <= grip else v - grip * (1 if v > 0 else -1)
        v = min(max(v, -velocity_limit), velocity_limit)
        q += STEP * v
        shown = min(max(shown, q - backlash), q + backlash)
    at = np.interp(t[-count:], fine, positions)
    return (1 + gain) * at + cosine * (np.cos(at) - 1)


def noisy(positions, rng, sigma=0.0012, slow=0.001):
    """Readings with jitter, a slow error as of a rough gear, and rounding to counts."""
    drift = np.zeros(len(positions))
    kicks = rng.normal(size=len(positions)) * slow * np.sqrt(1 - 0.95**2)
    for k in range(1, len(drift)):
        drift[k] = 0.95 * drift[k - 1] + kicks[k]
    read = positions + drift + rng.normal(size=len(positions)) * sigma
    return np.round(read / COUNT) * COUNT


def log_of(t, command, servos, seed=0, name='made.csv', every=1, late=0.0):
    """
    JointLog of several servos (keyword dicts) with one command.

    Args:
        t: times of the rows (N,) [s].
        command: commands (N,) [rad].
        servos: one dictionary for each joint.
        seed: of the noise.
        name: of the log.
        every: rows from one reading of the encoders to the next; the others repeat it.
        late: share of the readings that appear one row late.

    """
    rng = np.random.default_rng(seed)
    read = np.array([noisy(servo(t, command, **values)[::every], rng) for values in servos])
    at = np.arange(0, len(t), every) + (rng.random(read.shape[1]) < late)
    last = np.searchsorted(at[1:], np.arange(len(t)), side='right')
    return JointLog(name, t, tuple(range(1, len(servos) + 1)), read[:, last],
                    np.tile(command, (len(servos), 1)))


def write(path, log):
    """Write it as a CSV file with one command column."""
    with open(path, 'w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(['t_s', *(f'q{k}_rad' for k in log.joints), 'command_rad'])
        for row in zip(log.t, *log.measured, log.command[0], strict=True):
            writer.writerow([f'{value:.6f}' for value in row])
    return path
