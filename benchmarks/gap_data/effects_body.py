"""Hidden effects on bodies and air, each in more than one shape; see :mod:`gap_data.effects`."""

from math import cos, exp, pi, radians, sin, sqrt, tanh

import numpy as np

from gap_data.hidden import direction, Hidden, NOTHING
from gap_data.mjcf import main_body
from gap_data.truth import Robot

DRAWS = 1000      # of an inertia, until a body can have it ...
ROOM = 0.95       # ... with room for tolerances of 3 %


def mass(robot: Robot, hidden: Hidden, size, shape, rng):
    """More or less mass at the centre of gravity, ``size`` [kg]."""
    robot.mass += size
    return {'mass': robot.mass}


def centre_of_mass(robot, hidden, size, shape, rng):
    """The centre of gravity is ``size`` [m] away from base_link."""
    robot.centre = robot.centre + size * direction(rng)
    return {'offset': robot.centre}


def inertia(robot, hidden, size, shape, rng):
    """Each axis off by up to ``size`` [1], the worst by exactly that."""
    told = robot.inertia
    for _ in range(DRAWS):
        share = rng.uniform(-1, 1, 3)
        share[2] = min(max(share[2], -0.5), 0.5)
        share = size * share / np.abs(share).max()
        robot.inertia = told * (1 + share)
        robot.inertia[2] = min(robot.inertia[2], 0.9 * (robot.inertia[0] + robot.inertia[1]))
        # no moment is more than the others together, nor what the modules leave of it
        main = np.linalg.eigvalsh(main_body(robot)[2])
        if main[0] > 0 and main[2] < ROOM * (main[0] + main[1]):
            return {'inertia': robot.inertia}
    raise ValueError(f'no robot is off by {size:g} in its inertia')


def thrust_coefficient(robot, hidden, size, shape, rng):
    """All rotors give 1 + ``size`` times the thrust."""
    robot.thrust_scale = robot.thrust_scale * (1 + size)
    return {'scale': float(np.mean(robot.thrust_scale))}


def rotor_thrust_coefficient(robot, hidden, size, shape, rng):
    """One rotor gives 1 + ``size`` times the thrust."""
    i = int(rng.integers(4))
    robot.thrust_scale = robot.thrust_scale.copy()
    robot.thrust_scale[i] *= 1 + size
    return {'rotor': i + 1, 'scale': float(robot.thrust_scale[i])}


def torque_coefficient(robot, hidden, size, shape, rng):
    """The torque-to-thrust ratio is off by ``size`` [m]."""
    robot.ratio += size
    return {'torque_to_thrust_ratio': robot.ratio}


def ground_effect(robot, hidden, size, shape, rng):
    """
    Thrust grows by ``size`` [1] with the rotor 0.25 m above the floor, axis upright.

    plain: inverse square of the height; image: Cheeseman and Bennett's 1 / (1 - (r / 4 z)^2) with
    the radius that gives the gain; decay: exponential. The last two feel the tilt differently.
    """
    places = [tuple(map(float, p)) for p in robot.positions]
    image = size / (1 + size) * 0.25 ** 2

    def gain(i, s, f, axis, speed):
        r, (x, y, z) = s.rotation, places[i]
        height = max(0.08, s.position[2] + r[6] * x + r[7] * y + r[8] * z)
        upright = r[6] * axis[0] + r[7] * axis[1] + r[8] * axis[2]
        if upright <= 0 or height > 2.5:
            return 1.0
        if shape == 'image':
            return 1 + (1 / (1 - min(0.6, image / height ** 2)) - 1) * upright
        if shape == 'decay':
            return 1 + min(0.6, size * exp((0.25 - height) / 0.22)) * upright ** 3
        return 1 + min(0.6, size * (0.25 / height) ** 2) * upright ** 2

    hidden.gains.append(gain)
    return {'gain_at_0.25m': size}


def rotor_drag(robot, hidden, size, shape, rng):
    """
    Force in the rotors' planes against their motion, ``size`` [N s/m] for all at hover thrust.

    plain: grows with the root of the thrust; flapping: the disc leans back and, a little, to the
    side where its blades advance, and the lean saturates with the advance ratio.
    """
    hover, quarter = robot.hover_thrust, size / 4
    spins = [float(s) for s in robot.spin]

    def wrench(i, s, f, axis, speed):
        along = sum(a * v for a, v in zip(axis, speed))
        x, y, z = (v - along * a for a, v in zip(axis, speed))
        if shape == 'flapping':
            fast = sqrt(x * x + y * y + z * z)
            k = quarter * (max(f, 0.0) / hover) ** 0.65 / sqrt(1 + (fast / 6.0) ** 2)
            side = 0.15 * spins[i]
            a, b, c = axis
            return (-k * (x + side * (b * z - c * y)), -k * (y + side * (c * x - a * z)),
                    -k * (z + side * (a * y - b * x)), *NOTHING)
        k = quarter * sqrt(max(f, 0.0) / hover)
        return (-k * x, -k * y, -k * z, *NOTHING)

    hidden.wrenches.append(wrench)
    return {'coefficient': size}


def body_drag(robot, hidden, size, shape, rng):
    """
    Drag of the airframe, ``size`` [N s^2/m^2]; plain: isotropic and quadratic.

    blunt: 20 % more across than along the body's z, power 1.85 (equal at 2 m/s).
    """
    def body(s):
        x, y, z = s.velocity_world
        fast = sqrt(x * x + y * y + z * z)
        if shape != 'blunt':
            k = -size * fast
            return (k * x, k * y, k * z), NOTHING
        k = -size * 2.0 ** 0.15 * fast ** 0.85
        r = s.rotation
        a, b, c = s.velocity
        fx, fy, fz = 1.07 * k * a, 1.07 * k * b, 0.87 * k * c
        return (r[0] * fx + r[1] * fy + r[2] * fz, r[3] * fx + r[4] * fy + r[5] * fz,
                r[6] * fx + r[7] * fy + r[8] * fz), NOTHING

    hidden.body.append(body)
    return {'coefficient': size}


def axial_inflow(robot, hidden, size, shape, rng):
    """
    Thrust falls with the speed along the axis, ``size`` [N s/m] per rotor at hover thrust.

    plain: linear, with the root of the thrust; momentum: a rotor at fixed speed whose inflow
    angle closes, so that the loss bends with the speed.
    """
    hover = robot.hover_thrust

    def gain(i, s, f, axis, speed):
        if f < 0.2:
            return 1.0
        along = axis[0] * speed[0] + axis[1] * speed[1] + axis[2] * speed[2]
        change = size * along / sqrt(f * hover)
        if shape == 'momentum':
            # blade angle closes linearly, induced flow gives back a share that grows with climb
            return max(0.1, 1 - tanh(change) * (1 - 0.15 * tanh(along / 4.0)))
        return max(0.1, 1 - change)

    hidden.gains.append(gain)
    return {'per_rotor': size}


def translational_lift(robot, hidden, size, shape, rng):
    """
    Thrust grows with the speed across the axis, ``size`` [N s^2/m^2] per rotor.

    plain: quadratic; glauert: saturates as the induced velocity gets small.
    """
    def gain(i, s, f, axis, speed):
        if f < 0.2:
            return 1.0
        along = sum(a * v for a, v in zip(axis, speed))
        across = sum(v * v for v in speed) - along * along
        return 1 + size * across / ((1 + across / 49.0) if shape == 'glauert' else 1.0) / f

    hidden.gains.append(gain)
    return {'gain': size}


def tilt_thrust_loss(robot, hidden, size, shape, rng):
    """
    A tilted rotor blows on the arm: ``size`` [1] of its thrust is lost at 60 deg.

    plain: sin^2; sweep: grows as the angle to the power 1.5, flat beyond 90 deg; shadow: a smooth
    step about 40 deg, where the wake meets the body; lens: 1 - cos.
    """
    reference = radians(60)
    zero = 1 / (1 + exp(40 / 14))
    top = 1 / (1 + exp(-20 / 14)) - zero

    def gain(i, s, f, axis, speed):
        angle = abs((s.tilt[i] + pi) % (2 * pi) - pi)
        if shape == 'sweep':
            return 1 - size * (min(angle, pi / 2) / reference) ** 1.5
        if shape == 'shadow':
            return 1 - size * (1 / (1 + exp((40 - angle * 180 / pi) / 14)) - zero) / top
        if shape == 'lens':
            return 1 - size * (1 - cos(angle)) / 0.5
        return 1 - size * sin(angle) ** 2 / 0.75

    hidden.gains.append(gain)
    return {'loss_at_60deg': size}


def wind(robot, hidden, size, shape, rng):
    """A force fixed in world, ``size`` [N], mostly level; breathing: swells by 10 % about it."""
    way = direction(rng) * [1, 1, 0.25]
    force = size * way / np.linalg.norm(way)
    x, y, z = map(float, force)
    period, phase = rng.uniform(9, 20), rng.uniform(0, 2 * pi)

    def body(s):
        k = 1 + (0.1 * sin(2 * pi * s.t / period + phase) if shape == 'breathing' else 0.0)
        return (k * x, k * y, k * z), NOTHING

    hidden.body.append(body)
    return {'force': force}


def _angular_momentum(robot, size, shape):
    """Angular momentum [N m s] of a rotor's propeller at a thrust, and its slope [s m]."""
    hover = robot.hover_thrust
    if shape == 'offset':  # speed = a + b f, a line through hover with half the root's slope more
        return (lambda f: size * (0.4 + 0.6 * f / hover)), (lambda f: size * 0.6 / hover)
    return (lambda f: size * sqrt(max(f, 0.0) / hover)), (
        lambda f: 0.5 * size / sqrt(max(f, 0.3) * hover))


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def propeller_gyroscopic_torque(robot, hidden, size, shape, rng):
    """
    Turning a spinning propeller takes torque; ``size`` [N m s] is one's angular momentum.

    plain: only the turning; full: also the spinning up, as in nature.
    """
    momentum, slope = _angular_momentum(robot, size, shape)
    spins = [float(s) for s in robot.spin]
    arms = [(float(a[0]), float(a[1])) for a in robot.arms]

    def wrench(i, s, f, axis, speed):
        h = spins[i] * momentum(f)
        (wx, wy, wz), (ca, sa), qd = s.rate, arms[i], s.tilt_rate[i]
        tx, ty, tz = _cross((wx + qd * ca, wy + qd * sa, wz), axis)
        up = spins[i] * slope(f) * s.thrust_rate[i] if shape != 'plain' else 0.0
        return (*NOTHING, -h * tx - up * axis[0], -h * ty - up * axis[1], -h * tz - up * axis[2])

    hidden.wrenches.append(wrench)
    return {'angular_momentum_at_hover': size}


def rotor_acceleration_torque(robot, hidden, size, shape, rng):
    """Spinning up takes torque about the axis; ``size`` [N m s] is the momentum at hover."""
    _, slope = _angular_momentum(robot, size, shape)
    spins = [float(s) for s in robot.spin]

    def wrench(i, s, f, axis, speed):
        up = -spins[i] * slope(f) * s.thrust_rate[i]
        return (*NOTHING, up * axis[0], up * axis[1], up * axis[2])

    hidden.wrenches.append(wrench)
    return {'angular_momentum_at_hover': size}


def module_reaction(robot, hidden, size, shape, rng):
    """The multibody description itself, against a rigid model; the flight must be multibody."""
    parts = robot.numbers['parts']
    lever = parts['module_centre'][2]
    return {'module_inertia': parts['module_inertia'][0] + parts['module_mass'] * lever ** 2}
