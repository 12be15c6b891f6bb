"""Flights for the gap finder: random poses of `gap --next`, and both robot files of `improve`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from beetle_omni_ros.bags.log import FlightLog
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.bags.task_metrics import reduced, U_WINDOW
from beetle_omni_ros.control.tasks import POSE_DURATION, poses_task, random_poses, Task
from beetle_omni_ros.flight.campaign import Store, sweep
from beetle_omni_ros.flight.compare import ComparedFlight, fly_flight
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.mode import FLYING
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.show.page import Grid, number

DURATION = 56.0         # [s] of a task
STEP = 1.6              # [s] of a move between level poses
PERIOD = 0.1            # [s] between their set points
CONTROLLER = 'nmpc'
# Margins. A loaded pack gives less thrust than a full one, and gusts need some.
MOST_THRUST = 0.9       # of the largest thrust, while a pose is held
LEAST_HEIGHT = 0.35     # [m] of base_link; the feet are 0.16 m below


class Experiments:
    """
    Random poses as tasks of one robot.

    If its rotors tilt, it flies to each pose and holds it, as in the task ``randomN``. If not, it
    flies through level poses, after 8 s at the first one.
    """

    duration = DURATION

    def __init__(self, robot: RobotParameters):
        self._robot = robot

    @staticmethod
    def poses(seed: int, level: bool) -> np.ndarray:
        """(N, 6) x, y, z [m], roll, pitch, yaw [deg] from a seed."""
        step, lead = (STEP, POSE_DURATION - STEP) if level else (POSE_DURATION, 0.0)
        poses = random_poses(round((DURATION - lead) / step), seed).round(2)
        return poses * [0.5, 0.5, 1, 0, 0, 1] if level else poses

    def flown(self, poses: np.ndarray, plant: RobotParameters) -> FlightLog | None:
        """Fly poses with a plant in the simulator; None if a margin is lost."""
        task = poses_task('next flight', poses)
        try:
            log = fly(CONTROLLER, task, robot=self._robot, plant=plant)
        except RunError:
            return None
        return log if self.is_safe(log, task) else None

    def is_safe(self, log: FlightLog, task: Task) -> bool:
        """Whether each pose is reached, with margins of thrust and height, by the controller."""
        held = (log.command.t - log.begin) % POSE_DURATION >= U_WINDOW[0]
        thrust = log.command.thrust[held & (log.command.t >= log.begin)]
        height = log.truth.position[log.truth.t >= log.begin, 2]
        return metrics(log, task)['success_rate'] == 1 and self.is_gentle(thrust) \
            and height.min() >= LEAST_HEIGHT and all(mode.state == FLYING for t, mode in zip(
                log.state_t, log.states, strict=True) if t > log.begin)

    def is_gentle(self, thrust: np.ndarray) -> bool:
        """Whether thrusts (N, 4) [N] keep a margin."""
        return bool(thrust.max() <= MOST_THRUST * self._robot.rotors.thrust_max)

    @staticmethod
    def level_motion(poses: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) [m] and yaw (N,) [rad] of moves between poses, from the ground."""
        ground = poses[0] * [1, 1, 0, 0, 0, 1]
        rise = POSE_DURATION / 2 * np.arange(2)
        motion = _moved([*rise, *(POSE_DURATION + STEP * np.arange(len(poses)))],
                        np.vstack([ground, poses[0], poses]), period)
        return motion[:, 1:4], np.radians(motion[:, 6])

    @staticmethod
    def write(path: Path, poses: np.ndarray, level: bool, head: str) -> None:
        """Write poses as a task; ``head`` are lines of comment."""
        key, columns, rows = ('set_points', 'time [s], ', _moved(
            STEP * np.arange(len(poses)), poses, PERIOD)) if level else ('poses', '', poses)
        lines = [*(f'# {line}' for line in head.splitlines()),
                 f'# Rows: {columns}x, y, z [m], roll, pitch, yaw [deg].', f'{key}:',
                 *(f"- [{', '.join(f'{value:.5g}' for value in row + 0.0)}]" for row in rows)]
        write_text(path, '\n'.join([*lines, '']), 'task')


def _moved(times, poses, period):
    """Set points (N, 7), time [s] and pose: moves from rest to rest with continuous jerk."""
    times = np.asarray(times)
    t = period * np.arange(round(times[-1] / period) + 1)
    k = np.clip(np.searchsorted(times, t, side='right') - 1, 0, len(times) - 2)
    s = ((t - times[k]) / (times[k + 1] - times[k]))[:, None]
    share = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    return np.column_stack([t, poses[k] + share * (poses[k + 1] - poses[k])])


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
                         **{key: reduced(np.mean, [pose[key] for pose in flown])
                            for key in ERRORS}}
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
