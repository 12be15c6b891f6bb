"""
Changes of the servos between two response logs.

Both logs are fitted with the same parameters, each joint alone. As in `identify joint`, the prior
of the differences between servos on one bus is 10 % and 3 ms about their mean, which helps if a
slow log does not separate delay and stiffness.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import norm

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import GROUPS, Servos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import (
    decode,
    first_noise,
    fitted_samples,
    noise_around,
    prior_of,
    Problems,
    ServoFitter,
)
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, TERMS
from beetle_omni_ros.pages.table import Grid
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters

FITTED = ('natural_frequency', 'damping_ratio', 'delay', 'coulomb_friction', 'offset')
# Catalogue entry, parameter, unit. A log without a torque determines the dead band (friction over
# stiffness) and the lag behind a ramp better than the parameters that they consist of.
ROWS = tuple(
    row for name, parameters in GROUPS.items() for parameter in parameters
    for spec in [CATALOGUE[name].parameters[parameter]]
    if spec.log and (spec.log.each or not CATALOGUE[name].starts)
    for row in ((name, parameter, spec.unit), *((name, *more) for more in spec.log.better)))
MILLI = {'rad': ('mrad', 1e3), 's': ('ms', 1e3), 'N m': ('mN m', 1e3)}


def changes(before: JointLog, after: JointLog, robot: RobotParameters,
            p: GapParameters | None = None) -> list[dict]:
    """
    Compare the servos of two logs; the robot file is the start of both fits.

    Returns:
        a row for each joint of both logs and each of ``ROWS``: second ``log``, ``joint``, ``name``
        of the catalogue entry, ``parameter``, ``unit``, ``before``, ``after``, ``difference``, its
        95 % ``interval``, and ``significant``: at most 5 % of pairs of logs without a change have
        any significant row.

    """
    p = p or GapParameters.load()
    fits = [estimate(log, robot, p) for log in (before, after)]
    joints = [j for j in before.joints if j in after.joints]
    rows, least = [], norm.isf(p.log_changes_chance / 2 / max(len(joints) * len(ROWS), 1))
    for number in joints:
        pair = [(values[log.joints.index(number)], errors[log.joints.index(number)])
                for log, (values, errors) in zip((before, after), fits, strict=True)]
        for k, (name, parameter, unit) in enumerate(ROWS):
            (old, spread), (new, other) = ((v[k], e[k]) for v, e in pair)
            error, difference = float(np.hypot(spread, other)), float(new - old)
            reach = float(norm.isf(0.025)) * error
            rows.append({'log': after.name, 'joint': number, 'name': name,
                         'parameter': parameter, 'unit': unit,
                         'before': float(old), 'after': float(new), 'difference': difference,
                         'interval': [difference - reach, difference + reach],
                         'significant': bool(abs(difference) > least * error)})
    return rows


def estimate(log: JointLog, robot: RobotParameters,
             p: GapParameters) -> tuple[np.ndarray, np.ndarray]:
    """
    Zero, gains, friction and delay of each joint of a log.

    Returns:
        (J, 7) values in the order of ``ROWS``, and (J, 7) standard errors.

    """
    servos = Servos(robot, log.joints)
    start = servos.sets(servos.file_point[None])[0]
    count, free = len(log.joints), np.array([name in FITTED for name in NAMES])
    weight = np.tile(fitted_samples(log), (count, 1))
    start[:, INDEX['coulomb_friction']] = np.maximum(start[:, INDEX['coulomb_friction']], 0.005)
    start[:, INDEX['delay']] = np.maximum(start[:, INDEX['delay']], 0.008)
    noise = first_noise(log)
    problems = Problems.single_joints(np.arange(count), start, np.tile(free, (count, 1)), weight)
    for _ in range(2):
        # A weak prior of frequency and damping about the median joint regularises the fit.
        prior = prior_of(np.median(problems.points, axis=0), dict.fromkeys(
            ('natural_frequency', 'damping_ratio'), float(np.log(p.log_changes_factor))))
        fits = ServoFitter(log, noise, prior=prior).solve(problems, 15)
        problems = replace(problems, points=fits.points)
        noise = noise_around(log, decode(problems.points), weight[0])
    points, covariance = _pooled(ServoFitter(log, noise), problems, free)
    return _physical(points, covariance, free, servos)


def _pooled(fitter, problems, free):
    """(J, n) encoded values with the prior about the mean of the joints, (J n, J n) covariance."""
    count, size = len(problems.points), int(free.sum())
    precision = np.zeros((count * size, count * size))
    for j, (own, scatter) in enumerate(fitter.covariances(problems)):
        part = slice(j * size, (j + 1) * size)
        precision[part, part] = np.linalg.inv(scatter * own[np.ix_(free, free)])
    own = problems.points[:, free].ravel()
    apart = np.eye(count) - 1 / count
    names = [name for name, chosen in zip(NAMES, free, strict=True) if chosen]
    deviation = shipped().servo.common
    common = np.diag([(TERMS[n].scale / deviation[n])**2 if n in deviation else 0.0
                      for n in names])
    covariance = np.linalg.inv(precision + np.kron(apart, common))
    return (covariance @ precision @ own).reshape(count, size), covariance


def _physical(points, covariance, free, servos):
    """Values and standard errors in catalogue units, by finite differences."""
    count, size = points.shape
    scale = np.array([term.scale for term in TERMS.values()])[free]
    errors = np.zeros((count, len(ROWS)))

    def values(point):
        chosen = dict(zip([n for n, c in zip(NAMES, free, strict=True) if c], point * scale,
                          strict=True))
        frequency, damping = (np.exp(chosen[n]) for n in ('natural_frequency', 'damping_ratio'))
        kp = servos.robot.joints.inertia * frequency**2
        band, delay = chosen['coulomb_friction'], chosen['delay'] - servos.delays
        result = {'offset': -chosen['offset'], 'kp': kp, 'kd': 2 * damping * kp / frequency,
                'coulomb': kp * band, 'dead_band': band, 'delay': delay,
                'ramp_lag': delay + 2 * damping / frequency}
        return np.array([result[parameter] for _, parameter, _ in ROWS])

    result = np.array([values(point) for point in points])
    for j in range(count):
        slope = np.array([(values(points[j] + step) - values(points[j] - step)) / 0.02
                          for step in 0.01 * np.eye(size)])
        own = covariance[j * size:(j + 1) * size, j * size:(j + 1) * size]
        errors[j] = np.sqrt(np.diag(slope.T @ own @ slope))
    return result, errors


def sentences(rows: list[dict], log: str) -> list[str]:
    """One line for each significant change, or one line if there is none."""
    changed = [row for row in rows if row['significant']]
    if not changed:
        return [f'{log}: no significant change of zero, gains, friction or delay']
    return [f'{log}: {line(row)}' for row in changed]


def change_grids(rows: list[dict]) -> list[Grid]:
    """One table for each further log: before, after and difference."""
    result = []
    for log in dict.fromkeys(row['log'] for row in rows):
        cells = []
        for row in (r for r in rows if r['log'] == log):
            unit, factor = MILLI.get(row['unit'], (row['unit'], 1.0))
            old, new, difference, low, high = (factor * x for x in (
                row['before'], row['after'], row['difference'], *row['interval']))
            cells.append([str(row['joint']), f"{row['parameter']} [{unit}]", f'{old:.3g}',
                          f'{new:.3g}', f'{difference:+.3g}', f'{low:.3g}..{high:.3g}',
                          'yes' if row['significant'] else ''])
        result.append(Grid(f'Changes to {log}', ['joint', 'parameter', 'before', 'after',
                                                 'difference', '95 %', 'significant'], cells,
                           note='dead_band: friction over stiffness. ramp_lag: lag behind a ramp, '
                                'from delay and damping. significant: two logs without a change '
                                'have any such row in at most 5 of 100 cases.'))
    return result


def line(row: dict) -> str:
    """Text of a row, e.g. 'joint 2: joint_offset offset 0.4 to 18.2 mrad, change 17.8 ...'."""
    unit, factor = MILLI.get(row['unit'], (row['unit'], 1.0))
    old, new, difference, low, high = (factor * x for x in (
        row['before'], row['after'], row['difference'], *row['interval']))
    return (f"joint {row['joint']}: {row['name']} {row['parameter']} {old:.3g} to {new:.3g} "
            f'{unit}, change {difference:+.3g} ({low:.3g}..{high:.3g})')
