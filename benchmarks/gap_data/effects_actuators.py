"""Hidden effects of rotors and servos; see :mod:`gap_data.effects`."""

from math import exp, tanh

import numpy as np


def voltage_sag(robot, hidden, size, shape, rng):
    """
    Thrust falls with the pack's voltage, exponent ``size`` of V over the full voltage.

    plain: that power; square: tangent parabola at 22.8 V, and the speed control follows the
    voltage with 60 ms.
    """
    full = robot.numbers['robot']['full_voltage']
    lag = 1 - exp(-robot.numbers['step'] / 0.06)
    middle = 22.8 / full
    level, tangent = middle ** size, size * middle ** (size - 1)
    bend = 0.5 * size * (size - 1) * middle ** (size - 2)
    state = {'voltage': None}

    def gain(i, s, f, axis, speed):
        if shape != 'square':
            return (s.voltage / full) ** size
        if i == 0:
            before = state['voltage']
            state['voltage'] = s.voltage if before is None or s.t == 0 else (
                before + lag * (s.voltage - before))
        x = state['voltage'] / full - middle
        return level + tangent * x + bend * x * x

    hidden.gains.append(gain)
    return {'exponent': size}


def rotor_lag(robot, hidden, size, shape, rng):
    """
    Time constant off by ``size`` [s]; plain: first order.

    second: 12 % of it in a second lag in series; skewed: 15 % slower down than up, on average
    the same.
    """
    robot.time_constant = robot.time_constant + size
    hidden.rotor_poles = 0.12 if shape == 'second' else 0.0
    hidden.lag_asymmetry = 0.075 if shape == 'skewed' else 0.0
    return {'time_constant': float(np.mean(robot.time_constant))}


def thrust_saturation(robot, hidden, size, shape, rng):
    """Rotors give at most 15 N - ``size``; plain: a corner; soft: rounded over 0.4 N."""
    hidden.thrust_ceiling = 15.0 - size
    hidden.ceiling_softness = 0.4 if shape == 'soft' else 0.0
    return {'thrust_max': 15.0 - size}


def joint_bandwidth(robot, hidden, size, shape, rng):
    """Stiffness times 1 + ``size``, damping by the part of it that keeps the damping ratio."""
    robot.kp = robot.kp * (1 + size)
    robot.kd = robot.kd * (1 + size) ** (0.5 if shape == 'plain' else 0.8)
    return {'kp': float(np.mean(robot.kp)), 'kd': float(np.mean(robot.kd))}


def joint_velocity_limit(robot, hidden, size, shape, rng):
    """Servos turn at most 6.5 rad/s - ``size``; their torque falls towards that speed."""
    robot.velocity_limit = np.full(4, 6.5 - size)
    return {'velocity_limit': 6.5 - size}


def joint_torque_limit(robot, hidden, size, shape, rng):
    """Servos give at most 0.04 N m - ``size``."""
    robot.effort_limit = np.full(4, 0.04 - size)
    return {'effort_limit': 0.04 - size}


def joint_friction(robot, hidden, size, shape, rng):
    """
    Dry friction of ``size`` [N m] in every servo, more at standstill.

    plain: breaks away at once; stribeck: falls smoothly from stiction, with a little viscosity.
    """
    ratio = float(rng.uniform(1.1, 1.5))
    extra = size * (ratio - 1)
    width = 0.02 if shape == 'plain' else 0.15

    def friction(i, rate):
        return size + extra * exp(-(rate / width) ** 2)

    hidden.friction = friction
    if shape != 'plain':
        hidden.joint_torques.append(
            lambda i, angle, rate, s: -0.1 * size * tanh(rate / 2.0))
    return {'coulomb': size, 'stiction': size * ratio}


def joint_backlash(robot, hidden, size, shape, rng):
    """
    Play of ``size`` [rad] in all between encoder and rotor.

    plain: the rotor stays until a flank takes it along; sprung: flanks give way by a tenth of
    the play, and the thrust's torque pulls the rotor slowly to the middle.
    """
    half = size / 2
    play = [float(p) for p in rng.uniform(-half, half, 4)]
    soft = 0.1 * half
    relax = exp(-robot.numbers['step'] / 1.5)
    last = [None] * 4

    def error(i, angle, rate, s):
        before = last[i] if s.t > 0 and last[i] is not None else angle
        last[i] = angle
        play[i] -= angle - before  # the rotor stands still while the shaft moves
        if shape == 'sprung':
            play[i] *= relax
            over = abs(play[i]) - (half - soft)
            if over > 0:
                # a stiff flank: it gives way less and less
                held = half - soft + soft * tanh(over / soft)
                play[i] = held if play[i] > 0 else -held
        else:
            play[i] = min(max(play[i], -half), half)
        return play[i]

    hidden.tilt_errors.append(error)
    return {'gap': size}


def joint_deflection(robot, hidden, size, shape, rng):
    """The thrust line misses the shaft: it turns the servo by ``size`` [rad] for each newton."""
    stiffness = [float(k) for k in robot.kp]
    soft = 0.006 if shape == 'hardening' else 0.0  # [1/N] a gear that stiffens under load
    hover = robot.hover_thrust

    def torque(i, angle, rate, s):
        f = s.thrust[i]
        return stiffness[i] * size * f * (1 - soft * (f - hover))

    hidden.joint_torques.append(torque)
    return {'deflection_per_newton': size}


def joint_offset(robot, hidden, size, shape, rng):
    """One joint's true tilt is ``size`` [rad] more than its encoder says."""
    joint = int(rng.integers(4))
    hidden.tilt_errors.append(lambda i, angle, rate, s: size if i == joint else 0.0)
    return {'joint': joint + 1, 'offset': size}
