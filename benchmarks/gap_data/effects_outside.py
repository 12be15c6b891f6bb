"""Effects that no catalogue entry describes; the right answer is `unknown`."""

from math import cos, exp, pi, sin, sqrt, tanh

import numpy as np

from gap_data.hidden import direction, NOTHING


def vibration(robot, hidden, size, shape, rng):
    """A loose part shakes the body with ``size`` [N] at 2 to 4 Hz, and turns it a little."""
    way, speed = direction(rng), 2 * pi * rng.uniform(2.0, 4.0)
    phase, arm = rng.uniform(0, 2 * pi), 0.08 * direction(rng)
    turn = np.cross(arm, way)

    def body(s):
        k = size * sin(speed * s.t + phase)
        r, (x, y, z) = s.rotation, way
        return ((k * (r[0] * x + r[1] * y + r[2] * z), k * (r[3] * x + r[4] * y + r[5] * z),
                 k * (r[6] * x + r[7] * y + r[8] * z)), tuple(k * t for t in turn))

    hidden.body.append(body)
    return {}


def force_field(robot, hidden, size, shape, rng):
    """A jet of a fan somewhere in the room: up to ``size`` [N], only where it blows."""
    place = [rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6)]
    angle, width = rng.uniform(0, 2 * pi), rng.uniform(0.4, 0.7)
    x, y = cos(angle), sin(angle)

    def body(s):
        a, b = s.position[0] - place[0], s.position[1] - place[1]
        off = (-y * a + x * b) / width
        k = size * exp(-0.5 * off * off) * (1 + 0.5 * tanh(x * a + y * b))
        return (k * x, k * y, 0.1 * k), NOTHING

    hidden.body.append(body)
    return {}


def slosh(robot, hidden, size, shape, rng):
    """A mass of ``size`` [kg], a battery that is not tied down, swings at about 1.5 Hz."""
    speed = 2 * pi * rng.uniform(1.3, 2.0)
    hidden.slosh = {'mass': size, 'stiffness': size * speed ** 2,
                    'damping': 2 * 0.08 * speed * size, 'position': (0.0, 0.0, -0.03)}
    return {}


def wake(robot, hidden, size, shape, rng):
    """A rotor in another's wake loses up to ``size`` [1] of its thrust."""
    places = [tuple(map(float, p)) for p in robot.positions]
    hover = robot.hover_thrust

    def gain(i, s, f, axis, speed):
        lost = 0.0
        for j in range(4):
            if j == i or not s.axes:
                continue
            way = [a - b for a, b in zip(places[i], places[j])]
            far = sqrt(sum(w * w for w in way))
            toward = -sum(w * n for w, n in zip(way, s.axes[j])) / far
            if toward > 0:
                lost += size * s.thrust[j] / hover * toward ** 4
        return max(0.3, 1 - lost)

    hidden.gains.append(gain)
    return {}


def fade(robot, hidden, size, shape, rng):
    """Rotors 1 and 2 warm up and fade by ``size`` [1]; the others cool better, and hardly."""
    share = [1.0, 0.6, 0.15, 0.15]
    hidden.gains.append(lambda i, s, f, axis, speed: 1 - size * share[i] * s.heat[i])
    return {}


def cable(robot, hidden, size, shape, rng):
    """A cable that drags over a rail: it rubs with ``size`` [N] and hangs heavier with height."""
    anchor = [rng.uniform(-1, 1), rng.uniform(-1, 1), 0.0]

    def body(s):
        x, y, z = s.velocity_world
        fast = sqrt(x * x + y * y + z * z) + 0.05
        away = [p - a for p, a in zip(s.position, anchor)]
        far = sqrt(sum(a * a for a in away)) + 1e-6
        pull = 0.4 * size * max(0.0, far - 0.8)
        return tuple(-size * v / fast - pull * a / far
                     for v, a in zip((x, y, z), away)), NOTHING

    hidden.body.append(body)
    return {}


def flutter(robot, hidden, size, shape, rng):
    """A rotor's thrust goes up and down with the roll rate of the body: ``size`` [s/rad]."""
    i0 = int(rng.integers(4))

    def gain(i, s, f, axis, speed):
        return 1 + size * tanh(s.rate[0] + 0.5 * s.rate[2]) if i == i0 else 1.0

    hidden.gains.append(gain)
    return {}
