"""Logs beside two robots as the simulator flies them: errors as a table, and one picture."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from beetle_omni_ros.identify.rotor.results import RotorModel
from beetle_omni_ros.identify.servo.log import JointLog
from beetle_omni_ros.identify.servo.model import simulate
from beetle_omni_ros.identify.servo.robot import file_sets
from beetle_omni_ros.pages.figures import COLOURS, FAINT, INK, legend, panels, STYLE
from beetle_omni_ros.pages.page import Grid
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

SHOWN = 1.0     # [s] of a log
MILLI = 1e3


def flown(log: JointLog, robot: RobotParameters) -> np.ndarray:
    """(n, N) readings of a robot's servos behind the simulator's delays, with the log's zeros."""
    sets = file_sets(robot, flown=True)[np.array(log.joints) - 1]
    read = simulate(log, np.arange(len(sets)), sets)
    error = (read - log.measured)[:, log.fresh]
    return read - error.mean(axis=1, keepdims=True)


def errors(logs: Sequence[JointLog], robots: dict[str, RobotParameters]) -> Grid:
    """Table of RMS errors [mrad]."""
    rows = [[f'{log.name}, {name}', *(f'{MILLI * np.std(one):.1f}' for one in (
        flown(log, robot) - log.measured)[:, log.fresh])]
        for log in logs for name, robot in robots.items()]
    return Grid('RMS error of the servos as simulated, without zeros [mrad]',
                ['', *(f'joint {number}' for number in logs[0].joints)], rows)


def draw(path: Path, logs: Sequence[JointLog], rotor: RotorModel | None, lags: Sequence[dict],
         robots: dict[str, RobotParameters]) -> None:
    """
    Draw a segment of each joint log, thrust of the stand, time constants and stiffness.

    Args:
        path: picture, .png or .svg.
        logs: logs of joints.
        rotor: fits of the rotor logs; None without them.
        lags: lags of the rotor logs with intervals.
        robots: name -> robot; the last one has the intervals.

    Raises:
        ParameterError: the picture cannot be written.

    """
    with matplotlib.rc_context(STYLE):
        figure, axes = panels(2, 3, height=2.7)
        for axis, log in zip(axes[0], logs, strict=False):
            _response(axis, log, robots)
        _thrust(axes[1, 0], rotor, robots)
        _lags(axes[1, 1], lags, robots)
        _stiffness(axes[1, 2], robots)
        legend(figure, axes[0, 0])
        try:
            figure.savefig(path, dpi=150)
        except (OSError, ValueError) as error:
            raise ParameterError(f'{path}: cannot write the picture ({error})') from None


def _response(axis, log, robots):
    t, first = log.t - log.t[0], float(log.t[-1] - log.t[0]) / 2
    seen = (t >= first) & (t <= first + SHOWN)
    read = seen & log.fresh
    axis.plot(t[seen], log.command[0, seen], color=FAINT, lw=1.0, label='command')
    axis.plot(log.read_t[read] - log.t[0], log.measured[0, read], 'o', color=INK, ms=2.2,
              label='reading')
    for (name, robot), colour in zip(robots.items(), COLOURS[1::-1], strict=True):
        axis.plot(log.read_t[read] - log.t[0], flown(log, robot)[0, read], color=colour, lw=1.1,
                  label=name)
    axis.set(title=log.name, xlabel='time [s]', ylabel=f'joint {log.joints[0]} [rad]')


def _thrust(axis, rotor, robots):
    axis.set(title='Thrust', xlabel='duty x voltage [V]', ylabel='thrust [N]')
    if rotor and rotor.rows:
        axis.plot(rotor.rows['duty'] * rotor.rows['voltage'], rotor.rows['thrust'], '.', color=INK,
                  ms=2.2)
    for robot, colour in zip(robots.values(), COLOURS[1::-1], strict=True):
        for row in robot.rotors.map:
            thrust = np.linspace(0, row.thrust_max, 100)
            duty = np.polyval(row.coefficients[::-1], thrust / 10) / 50 - 1
            axis.plot(duty * row.voltage, thrust, color=colour, lw=0.8)


def _lags(axis, lags, robots):
    axis.set(title='Time constant of thrust', xlabel='[ms]')
    shown = [(f'{lag["log"].removesuffix(".csv")},\n{name}', lag[key]) for lag in lags
             for name, key in (('rising', 'up'), ('falling', 'down')) if lag[key]]
    for k, (_, one) in enumerate(shown):
        _bar(axis, k, one['value'], one['interval'], INK)
    for k, (robot, colour) in enumerate(zip(robots.values(), COLOURS[1::-1], strict=True)):
        _bar(axis, len(shown) + k, robot.rotors.time_constant,
             robot.interval('rotors.time_constant'), colour)
    axis.set_yticks(range(len(shown) + len(robots)), [name for name, _ in shown] + list(robots),
                    fontsize=7)
    axis.invert_yaxis()


def _bar(axis, at, value, ends, colour):
    axis.plot(MILLI * np.array(ends), [at, at], color=colour, lw=1.6)
    axis.plot(MILLI * value, at, 'o', color=colour, ms=4)


def _stiffness(axis, robots):
    axis.set(title='Stiffness of the servos', xlabel='joint', ylabel='Kp [N m/rad]')
    for robot, colour in zip(robots.values(), COLOURS[1::-1], strict=True):
        value = np.broadcast_to(robot.joints.kp, 4)
        low, high = (np.broadcast_to(end, 4) for end in robot.interval(
            'effects.joint_bandwidth.kp' if 'joint_bandwidth' in robot.effects else 'joints.kp'))
        axis.errorbar(np.arange(1, 5), value, [value - low, high - value], fmt='o', color=colour,
                      ms=4, lw=1.6)
    axis.set_xticks(range(1, 5))
    axis.set_ylim(bottom=0)
