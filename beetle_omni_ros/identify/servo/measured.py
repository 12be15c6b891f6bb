"""What a robot file states of identified servos."""

from copy import copy
from dataclasses import replace

import numpy as np

from beetle_omni_ros.identify.robot_file import Measured, rounded
from beetle_omni_ros.identify.servo.fit import decoded, HIGH, LOW, Search, ServoModel, STARTS
from beetle_omni_ros.identify.servo.model import (
    catalogue_values,
    INDEX,
    JOINTS,
    NAMES,
    own_delay,
)
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters, TILT_LAG

# Standard deviation of the gains between logs, for intervals. From 0.1 to 0.4 it moves the gains
# of the measured logs by less than 5 %, and doubles the width of the least informative one.
BETWEEN = 0.2
GAINS = 'natural_frequency', 'damping_ratio'
DRAWS = 4000            # of the parameters, whose quantiles are the intervals
TAILS = 2.5, 97.5       # [%] outside a 95 % interval
DELAY = 'effects.joint_command_latency.delay'
KP, KD = 'effects.joint_bandwidth.kp', 'effects.joint_bandwidth.kd'
HOW = 'mean of the logs, with the same gains; interval: also of each log, with gains that ' \
      'differ between logs'


def measured(search: Search, robot: RobotParameters) -> list[Measured]:
    """
    Effects of the selected servo model.

    A value is that of servos with the same gains in all logs. Its interval also covers gains that
    differ between logs, because a log seldom separates bandwidth, damping and delay. A zero is not
    written: it is set anew by each homing, and differs between logs. A weight on the joints has no
    key in a robot file.
    """
    servos, names = search.servos, [log.name for log in search.servos.logs]
    of_logs = search.values()
    delay, zeros = of_logs[:, INDEX['delay']].mean(), 1e3 * of_logs[:, INDEX['offset']]
    best = _drawn(search, search.chosen, None, robot, 1)
    draws = [_drawn(search, trial, log, robot, DRAWS)
             for trial in (search.chosen, _with_other_gains(search))
             for log in (None, *range(len(servos.logs)))]
    found = []
    for key, value in best.items():
        _, entry, name = key.split('.')
        if CATALOGUE[entry].parameters[name].form:
            found.append(Measured(key, float(value[0, 0]), None, names, ''))
        else:
            found.append(Measured(
                key, rounded(value, 4), _interval(value, [each[key] for each in draws]), names,
                HOW if key != DELAY else f'{delay:.4f} s in the mean of the logs, minus '
                f'{own_delay():.3f} s that the simulator has; at least 0'))
    lag, *lags = [each[KD] / each[KP] + each[DELAY] for each in (best, *draws)]
    return [*found, Measured(
        TILT_LAG, None, _interval(lag, [np.concatenate(lags, axis=1)]), names,
        'Kd / Kp plus delay [s]; the logs determine the sum better than its parts'), Measured(
        'not written: joint_offset', None, None, names,
        f'zeros of {zeros.min():.1f} to {zeros.max():.1f} mrad; each homing sets them')]


def _interval(value, draws):
    """95 % interval that covers a value (joints, 1) and each of some (joints, DRAWS)."""
    low, high = np.percentile(draws, TAILS, axis=2)
    return rounded([np.minimum(low.min(axis=0), value[:, 0]),
                    np.maximum(high.max(axis=0), value[:, 0])], 4)


def _with_other_gains(search):
    """The selected model with gains that differ between logs."""
    servos = copy(search.servos)
    servos.spreads = [replace(spread, groups=spread.groups | {'log': BETWEEN})
                      if name in GAINS else spread
                      for name, spread in zip(NAMES, servos.spreads, strict=True)]
    return servos.fit(search.chosen.entries, starts=(search.chosen, *STARTS))


def _drawn(search: Search, trial: ServoModel, log: int | None, robot: RobotParameters, draws: int
           ) -> dict[str, np.ndarray]:
    """
    Values (joints, draws) of each key, of a log or of the mean of all logs (None).

    One draw is the estimate. A joint that a log lacks is that of all logs, and one without a log
    the median of the others.
    """
    fit, base = trial.fit, search.servos.base
    x = fit.x[:, None]
    if draws > 1:
        factor = np.linalg.cholesky(fit.covariance() + 1e-12 * np.eye(len(fit.x)))
        x = x + factor @ np.random.default_rng(0).normal(size=(len(fit.x), draws))
    sets = {}
    for number in sorted({number for *_, number in search.servos.units}):
        every = [u for u, (*_, own) in enumerate(search.servos.units) if own == number]
        units = [u for u in every if search.servos.units[u][0] == log] or every
        sets[number - 1] = base[units[0]][:, None] + fit.s[units].mean(axis=0) @ x
    bounded = np.clip(list(sets.values()), LOW[:, None], HIGH[:, None])
    values = catalogue_values(decoded(bounded.transpose(2, 0, 1)).T, robot)
    result = {}
    for entry in trial.entries:
        for name, given in values.get(entry, {}).items() if entry != 'joint_offset' else ():
            parameter, key = CATALOGUE[entry].parameters[name], f'effects.{entry}.{name}'
            value = np.broadcast_to(given, (len(sets), draws))
            if key == DELAY:
                value = np.maximum(value.mean(axis=0, keepdims=True), 0)
            elif not (parameter.of_each or isinstance(parameter.neutral, tuple)):
                value = value.mean(axis=0, keepdims=True)
            else:
                known, value = value, np.tile(np.median(value, axis=0), (JOINTS, 1))
                value[list(sets)] = known
            result[key] = value
    return result
