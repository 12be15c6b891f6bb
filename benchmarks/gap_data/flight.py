"""One flight in closed loop: what really happened, a thousand times a second."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from gap_data.controller import PoseController
from gap_data.courses import Course, make_course, RATE
from gap_data.hidden import Hidden
from gap_data.plant import Plant
from gap_data.truth import Robot

COLUMNS = {'position': 3, 'quaternion': 4, 'velocity': 3, 'rate': 3, 'specific_force': 3,
           'tilt': 4, 'tilt_rate': 4, 'thrust': 4, 'voltage': 1, 'current': 1}
TOO_FAR = 1.5       # [m] from the reference: the flight counts as lost
TOO_LOW = 0.12      # [m]
ATTEMPTS = 4        # each calmer than the one before


class LostFlight(RuntimeError):
    """The controller could not hold the robot; the text says when."""


@dataclass
class Truth:
    """
    What really happened.

    Attributes:
        t: (N,) [s], one row a step.
        columns: by the names of ``COLUMNS``, (N, size); quaternion w x y z, rates and specific
            force in base_link, at the IMU's place.
        command_t: (M,) stamps; command_tilt, command_thrust: (M, 4).
        course: what was asked for.

    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    command_t: np.ndarray
    command_tilt: np.ndarray
    command_thrust: np.ndarray
    course: Course


def fly(robot: Robot, hidden: Hidden, *, kind: str, duration: float, seed: int,
        multibody: bool, gust: bool, conditions: str) -> Truth:
    """
    Fly one course; a lost flight is tried again, calmer.

    Args:
        robot: what is true.
        hidden: the effects.
        kind: of the course, see :func:`gap_data.courses.make_course`.
        duration: [s].
        seed: of this flight alone.
        multibody: which description of the robot.
        gust: whether a coloured wrench pushes.
        conditions: 'nominal' or 'published' latencies of the controller's state.

    Raises:
        LostFlight: lost at every attempt.

    """
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        course = make_course(kind, duration, rng, vigour=0.8 ** attempt)
        try:
            return _attempt(robot, hidden, kind, course, duration, rng, multibody, gust,
                            conditions)
        except LostFlight as error:
            reason = error
    raise LostFlight(f'{kind} flight, seed {seed}: {reason}')


def _attempt(robot, hidden, kind, course, duration, rng, multibody, gust, conditions):
    numbers = robot.numbers
    lively = kind in ('poses', 'lemniscate')
    controller = PoseController(robot, rng, lively)
    up = course.rotation[0].T @ [0.0, 0.0, numbers['robot']['mass'] * numbers['robot']['gravity']]
    tilt, thrust = controller.trim(up)
    charge = rng.uniform(*numbers['battery']['charge'])
    plant = Plant(robot, hidden, multibody=multibody, position=course.position[0],
                  quaternion=_wxyz(course.rotation[0]), tilt=tilt, thrust=thrust,
                  charge=charge, command_age=numbers['command_age'])
    step = plant.step_length
    force, torque = (draw_gust(numbers['gust'], duration, step, rng) if gust else (None, None))
    sight = Sight(numbers, conditions, rng, step)
    count, period = int(round(duration / step)), int(round(controller.PERIOD / step))
    log = np.empty((count, sum(COLUMNS.values())))
    commands = []
    for k in range(count):
        if k % period == 0:
            t = k * step
            row = int(round(t * RATE))
            reference = (course.position[row], course.velocity[row], course.acceleration[row],
                         course.rotation[row], course.rate[row])
            state = sight.state(log, k) if k else (
                course.position[0], np.zeros(3), course.rotation[0], np.zeros(3))
            _check(state, reference, t)
            tilt, thrust = controller.step(t, state, reference)
            plant.command(t, tilt, thrust)
            commands.append((t, *tilt, *thrust))
        s = plant.step() if force is None else plant.step(force[k], torque[k])
        log[k] = (*s.position, *s.quaternion, *s.velocity_world, *s.rate,
                  *plant.specific_force, *s.tilt, *s.tilt_rate, *s.thrust, s.voltage,
                  plant.pack.current)
    commands = np.array(commands)
    return Truth(np.arange(count) * step, _split(log), commands[:, 0], commands[:, 1:5],
                 commands[:, 5:9], course)


def draw_gust(settings: dict, duration: float, step: float,
              rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    Force in world and torque in base_link, (N, 3) each, one row a step.

    A second-order (Dryden-like) colouring: white noise through two equal lags.
    """
    count = int(round(duration / step)) + 1
    force, torque = (_coloured(count, step, rng.uniform(*settings['time']),
                               rng.uniform(*settings[kind]), rng) for kind in ('force', 'torque'))
    return force, torque


def _coloured(count, step, time, rms, rng):
    pole = np.exp(-step / (0.5 * time))
    white = rng.standard_normal((count + 4000, 3))
    wave = lfilter([1.0], [1.0, -2 * pole, pole * pole], white, axis=0)[4000:]
    # the filter's stationary deviation, not the sample's, so that seeds differ in strength
    gain = np.sqrt((1 + pole ** 2) / (1 - pole ** 2) ** 3)
    return rms / gain * wave


class Sight:
    """What the controller sees: truth of some time ago, with a little noise."""

    NOISE = (0.002, 0.01, 0.002, 0.006)  # [m], [m/s], [rad], [rad/s] of a filtered estimate

    def __init__(self, numbers, conditions, rng, step):
        ages = numbers['sensors']['latency'][conditions]
        self._ages = [int(round(rng.uniform(*ages[key]) / step))
                      for key in ('pose', 'velocity', 'rate')]
        self._rng = rng

    def state(self, log, k):
        """Position, velocity, rotation, rate as the controller knows them at row ``k``."""
        pose, velocity, rate = (log[max(0, k - 1 - age)] for age in self._ages)
        noise = self._rng.standard_normal((4, 3))
        rotation = _matrix(pose[3:7])
        x, y, z = noise[2] * self.NOISE[2]
        rotation = rotation @ np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
        return (pose[0:3] + self.NOISE[0] * noise[0], velocity[7:10] + self.NOISE[1] * noise[1],
                rotation, rate[10:13] + self.NOISE[3] * noise[3])


def _check(state, reference, t):
    away = np.linalg.norm(state[0] - reference[0])
    if not away < TOO_FAR or state[0][2] < min(TOO_LOW, reference[0][2] - 0.1):
        raise LostFlight(f'{away:.1f} m from the reference after {t:.1f} s')


def _split(log):
    ends = np.cumsum(list(COLUMNS.values()))[:-1]
    return dict(zip(COLUMNS, np.split(log, ends, axis=1)))


def _matrix(q):
    w, x, y, z = q
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def _wxyz(matrix):
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    return [w, x, y, z]
