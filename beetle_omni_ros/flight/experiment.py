"""
Flights for the gap finder: manoeuvres of `gap --next`, and both robot files of `improve`.

Each manoeuvre lasts one block of the gap finder. It begins and ends at rest at one pose, so that
any sequence of manoeuvres is a task, and the information of its blocks adds up.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation

from beetle_omni_ros.bags.log import FlightLog
from beetle_omni_ros.control.tasks import POSE_DURATION, trajectory_task
from beetle_omni_ros.flight.campaign import Store, sweep
from beetle_omni_ros.flight.compare import ComparedFlight, fly_flight
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.mode import FLYING
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.show.page import Grid, number

DURATION = 8.0          # [s] of a manoeuvre
LONGEST = 60.0          # [s] of a task, with the hover before its manoeuvres
START = (0.0, 0.0, 1.2, 0.0, 0.0, 0.0)      # pose between manoeuvres [m], [rad]
PERIOD, SAMPLE = 0.1, 0.02      # [s] between set points, and between the points that are flown
RAMP = 2.0              # [s] from rest to full amplitude
CONTROLLER = 'nmpc'
# Margins of a flight. A loaded pack gives less thrust than a full one, and gusts need some.
MOST_THRUST = 0.9       # of the largest thrust
MOST_TILT = 0.95        # of the range of the joints
MOST_RATE = 0.95        # of the largest rate of a joint; faster ones are taken for a limit
LEAST_HEIGHT = 0.35     # [m] of base_link; the feet are 0.16 m below
MOST_ERROR = 0.5        # [m] from the target


def _held(axis: int, size: float) -> Callable[[np.ndarray], np.ndarray]:
    """Go to an offset, stay, return."""
    return lambda t: _on(axis, size * _window(t))


def _swung(axis: int, size: float, frequency: float, last: float | None = None
           ) -> Callable[[np.ndarray], np.ndarray]:
    """Sine whose frequency rises to ``last`` [Hz]."""
    rise = ((last or frequency) - frequency) / (2 * DURATION)
    return lambda t: _on(axis, size * _window(t) * np.sin(
        2 * np.pi * (frequency + rise * t) * t))


def _window(t):
    """(N,) from 0 to 1 and back to 0, with continuous jerk."""
    s = np.clip(np.minimum(t, DURATION - t) / RAMP, 0, 1)
    return s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)


def _on(axis, values):
    offset = np.zeros((len(values), 6))
    offset[:, axis] = values
    return offset


# Name -> offset (N, 6) from START over time (N,): x, y, z [m], roll, pitch, yaw [rad].
X, Y, Z, ROLL, PITCH, YAW = range(6)
MANOEUVRES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    'hover at 0.5 m': _held(Z, -0.7),
    'passes along x': _swung(X, 1.2, 0.3),
    'passes along y': _swung(Y, 1.2, 0.3),
    'climbs': _swung(Z, 0.5, 0.4),
    'chirp along x': _swung(X, 0.05, 0.3, 2.0),
    'chirp along z': _swung(Z, 0.04, 0.3, 2.0),
    'roll 90 deg': _held(ROLL, np.pi / 2),
    'roll 180 deg': _held(ROLL, np.pi),
    'pitch 80 deg': _held(PITCH, np.radians(80)),
    'yaw 180 deg': _held(YAW, np.pi),
    'roll swings': _swung(ROLL, 0.7, 0.5),
    'pitch swings': _swung(PITCH, 0.7, 0.5),
    'yaw swings': _swung(YAW, 0.9, 0.5),
    'roll chirp': _swung(ROLL, 0.2, 0.4, 2.0),
    'pitch chirp': _swung(PITCH, 0.2, 0.4, 2.0),
    'yaw chirp': _swung(YAW, 0.25, 0.4, 2.0),
}
LEVEL = tuple(name for name in MANOEUVRES if name.split()[0] not in ('roll', 'pitch', 'chirp'))


class Experiments:
    """Flights of manoeuvres by the simulator."""

    names = tuple(MANOEUVRES)
    level = LEVEL           # those of a robot whose rotors do not tilt
    duration = DURATION
    most = int((LONGEST - POSE_DURATION) / DURATION)
    lead = POSE_DURATION

    def __init__(self, robot: RobotParameters):
        self._robot = robot

    def flown(self, names: Sequence[str], plant: RobotParameters | None = None
              ) -> FlightLog | None:
        """Fly manoeuvres one after the other with a plant, by default the robot; None: a crash."""
        times, poses = set_points(names, SAMPLE)
        task = trajectory_task('next flight', times, poses[:, :3], Rotation.from_euler(
            'xyz', poses[:, 3:]).as_quat())
        try:
            log = fly(CONTROLLER, task, robot=self._robot, plant=plant or self._robot)
        except RunError:
            return None
        return None if log.meta['crashed'] else log

    def why_unsafe(self, names: Sequence[str], log: FlightLog) -> dict[str, str]:
        """Manoeuvres without margin to a limit, each with the first one that it reaches."""
        joints, rotors = self._robot.joints, self._robot.rotors
        times, poses = set_points(names, SAMPLE)
        begin = log.begin + POSE_DURATION
        series, tilt = log.truth, log.joint.position
        wanted = np.stack([np.interp(series.t - begin, times, poses[:, k]) for k in range(3)], 1)
        rate = np.abs(np.gradient(tilt, log.joint.t, axis=0)).max(axis=1)
        checks = (
            ('thrust', log.command.t, log.command.thrust.max(axis=1)
             > MOST_THRUST * rotors.thrust_max),
            ('range of the joints', log.joint.t, np.abs(tilt).max(axis=1)
             > MOST_TILT * joints.position_limit),
            ('rate of the joints', log.joint.t, rate > MOST_RATE * joints.velocity_limit),
            ('height', series.t, series.position[:, 2] < LEAST_HEIGHT),
            ('distance from the target', series.t, np.linalg.norm(
                series.position - wanted, axis=1) > MOST_ERROR),
            ('state', log.state_t, np.array([mode.state != FLYING for mode in log.states])))
        found: dict[str, str] = {}
        for what, t, beyond in checks:
            places = np.floor((t[beyond] - begin) / DURATION).astype(int)
            for k in np.unique(places[(places >= 0) & (places < len(names))]):
                found.setdefault(names[k], what)
        return found

    @staticmethod
    def level_motion(names: Sequence[str], period: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) [m] and yaw (N,) [rad], from a start on the ground."""
        _, poses = set_points(names, period)
        rise = np.zeros((round(POSE_DURATION / period), 6))
        rise[:, 2] = START[2] * _window(period * np.arange(len(rise)) * 0.5)
        poses = np.concatenate([rise, poses])
        return poses[:, :3], poses[:, 5]

    @staticmethod
    def write(path: Path, names: Sequence[str], head: str) -> None:
        """Write the set points of manoeuvres as a task; ``head`` are lines of comment."""
        times, poses = set_points(names, PERIOD)
        rows = np.column_stack([times, poses[:, :3], np.degrees(poses[:, 3:])])
        lines = [f"- [{', '.join(f'{value:.5g}' for value in row + 0.0)}]" for row in rows]
        text = '\n'.join(f'# {line}'.rstrip() for line in [
            *head.splitlines(), 'Rows: time [s], x, y, z [m], roll, pitch, yaw [deg].'])
        write_text(path, f'{text}\nset_points:\n' + '\n'.join(lines) + '\n', 'task')


def set_points(names: Sequence[str], period: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) times [s] and (N, 6) poses [m], [rad] of manoeuvres."""
    count = round(DURATION / period)
    t = period * np.arange(count)
    offsets = np.concatenate([*(MANOEUVRES[name](t) for name in names), np.zeros((1, 6))])
    return period * np.arange(len(offsets)), np.array(START) + offsets


# --- flights with the file before and with the corrected one -------------------------------------

FILES = 'before', 'after'
# Result -> label, factor of its unit, digits.
ERRORS = {'U_position_m': ('U position, mean [mm]', 1e3, 2),
          'U_orientation_deg': ('U orientation, mean [deg]', 1.0, 2),
          'L_position_m': ('L position, mean [mm]', 1e3, 1),
          'L_orientation_deg': ('L orientation, mean [deg]', 1.0, 2)}
WORSE = 0.05        # [1] increase of an error with which a file is not recommended
CERTAIN = 1.645     # standard errors of the mean: 95 %, one-sided


def before_and_after(robot: Path | None, corrected: Path, plant: Path | None,
                     controllers: Sequence[str], task: str, seeds: Sequence[int],
                     folder: Path, jobs: int | None = None,
                     console: Console | None = None) -> dict:
    """
    Fly controllers with a robot file and with the corrected one on the same plant.

    Arguments are as of `beetle_omni improve`; one flight for each of ``seeds``. ``folder`` keeps
    finished flights, so that a repeated call flies the rest.

    Returns:
        controller -> 'before' and 'after' with reached, poses and the means of ``ERRORS``,
        'ratio' of each error, 'worse': the errors that are more than 5 % larger with 95 %
        certainty, by the differences of the poses, and 'better': none is, and no pose is lost.

    """
    poses: dict[str, dict[str, list]] = {name: {} for name in controllers}
    for file, path in zip(FILES, (str(robot or ''), str(corrected)), strict=True):
        flights = [ComparedFlight(task, 'nominal', name, seed, plant=str(plant or corrected),
                                  robot=path) for seed in seeds for name in controllers]
        flown = sweep(fly_flight, [(flight, flight.make_task()) for flight in flights],
                      store=Store(folder / file), jobs=jobs, console=console)
        for flight, result in zip(flights, flown, strict=True):
            if result['failure']:
                raise RunError(f"{flight.name}: {result['failure']}")
            poses[flight.controller].setdefault(file, []).extend(result['metrics']['poses'])
    return {name: compared(each) for name, each in poses.items()}


def compared(poses: dict[str, list[dict]]) -> dict:
    """Summary of the poses flown with each of ``FILES``; see :func:`before_and_after`."""
    made: dict = {file: {'reached': sum(pose['reached'] for pose in flown), 'poses': len(flown),
                         **{key: mean([pose[key] for pose in flown]) for key in ERRORS}}
                  for file, flown in poses.items()}
    before, after = (made[file] for file in FILES)
    made['ratio'] = {key: after[key] / before[key] if before[key] and after[key] else None
                     for key in ERRORS}
    made['worse'] = [key for key in ERRORS if is_worse(*(
        [pose[key] for pose in poses[file]] for file in FILES))]
    made['better'] = after['reached'] >= before['reached'] and not made['worse']
    return made


def is_worse(before: list[float | None], after: list[float | None]) -> bool:
    """Whether an error certainly increases by more than ``WORSE``, over poses of both flights."""
    pairs = np.array([pair for pair in zip(before, after, strict=True) if None not in pair])
    if not len(pairs):
        return True         # nothing shows that it does not
    more = pairs[:, 1] - (1 + WORSE) * pairs[:, 0]
    spread = more.std(ddof=1) if len(more) > 1 else 0.0
    return bool(more.mean() > CERTAIN * spread / np.sqrt(len(more)))


def mean(values: list[float | None]) -> float | None:
    """Mean of the poses that were flown; None without any."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def improvement_grid(results: dict, title: str) -> Grid:
    """Table of :func:`before_and_after`."""
    rows = [['poses reached', *(f"{made[file]['reached']} of {made[file]['poses']}"
                                for made in results.values() for file in FILES)]]
    for key, (label, factor, digits) in ERRORS.items():
        rows.append([label, *(
            number(made[file][key] if made[file][key] is None else factor * made[file][key],
                   digits) for made in results.values() for file in FILES)])
    return Grid(title, ['', *(f'{name}, {file}' for name in results for file in FILES)], rows)


def conclusions(results: dict) -> list[str]:
    """One sentence for each controller."""
    made = []
    for name, found in results.items():
        worse = [ERRORS[key][0].partition(',')[0] for key in found['worse']]
        lost = found['before']['reached'] - found['after']['reached']
        reasons = [*([f'{lost} more poses are missed'] if lost > 0 else []),
                   *([f"{' and '.join(worse)} {'is' if len(worse) == 1 else 'are'} more than 5 % "
                      'larger'] if worse else [])]
        made.append(f'{name} flies better with the corrected file, or as well.' if found['better']
                    else f"{name} stays with the file before: {', and '.join(reasons)}.")
    return made
