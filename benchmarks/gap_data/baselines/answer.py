"""What the baselines share: reading, stacking, and writing the interface's JSON."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
import sys

import numpy as np

from gap_data.baselines.logs import load, UnusableLog
from gap_data.baselines.residual import EFFECTS, jacobian, Model, SIZE, SLICES

INDEXED = {'rotor_thrust_coefficient': 'rotor', 'joint_offset': 'joint'}
# columns (SIZE,) -> chosen names in order, theta (SIZE,), standard deviations (SIZE,)
Choose = Callable[[np.ndarray, np.ndarray], tuple[list[str], np.ndarray, np.ndarray]]


def answer(choose: Choose, runs, holdout, robot, json_path) -> int:
    """Run one baseline; the status of the process."""
    try:
        model = Model(robot)
    except (KeyError, TypeError, OSError) as error:
        print(f'{robot}: not a robot file ({error})', file=sys.stderr)
        return 2
    try:
        fits = [jacobian(load(path), model) for path in runs]
        held = [jacobian(load(path), model) for path in holdout] or fits
    except UnusableLog as error:
        _write(json_path, 'bad_data', [], None, reason=str(error))
        return 0
    scale = np.sqrt(np.mean(np.concatenate([r for r, _ in fits]) ** 2, axis=0)) + 1e-12
    everything, _ = _solve(fits, scale, list(EFFECTS))
    noise = np.sqrt(np.mean(np.concatenate(
        [(r + s @ everything) for r, s in fits]) ** 2, axis=0)) + 1e-12
    columns, target = _stack(fits, noise)
    names, theta, deviation = choose(columns, target)
    effects = [_effect(name, theta, deviation, model) for name in names]
    before, after = _rms(held, noise, np.zeros(SIZE)), _rms(held, noise, theta)
    floor = _rms(held, noise, everything)
    _write(json_path, 'named' if effects else 'no_gap', effects, (before, after, floor))
    return 0


def _stack(parts, noise):
    slopes = np.concatenate([(s / noise[:, None]).reshape(-1, SIZE) for _, s in parts])
    return slopes, np.concatenate([(r / noise).ravel() for r, _ in parts])


def _solve(parts, noise, names):
    slopes, target = _stack(parts, noise)
    return fit(slopes, target, names)


def fit(columns: np.ndarray, target: np.ndarray, names: list[str]) -> tuple:
    """
    Least squares of the named effects alone.

    Returns:
        theta (SIZE,), zero for others, and the sum of squares that is left.

    """
    chosen = np.concatenate([np.arange(SIZE)[SLICES[name]] for name in names])
    size = np.linalg.norm(columns[:, chosen], axis=0) + 1e-12
    found = np.linalg.lstsq(columns[:, chosen] / size, -target, rcond=1e-9)[0] / size
    theta = np.zeros(SIZE)
    theta[chosen] = found
    left = target + columns[:, chosen] @ found
    return theta, float(left @ left)


def deviations(columns: np.ndarray, names: list[str], variance: float) -> np.ndarray:
    """Standard deviations (SIZE,) under white noise of a variance."""
    chosen = np.concatenate([np.arange(SIZE)[SLICES[name]] for name in names])
    size = np.linalg.norm(columns[:, chosen], axis=0) + 1e-12
    normal = (columns[:, chosen] / size).T @ (columns[:, chosen] / size)
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(normal, rcond=1e-12)), 0) * variance) / size
    result = np.zeros(SIZE)
    result[chosen] = spread
    return result


def _rms(parts, noise, theta):
    return float(np.sqrt(np.mean(np.concatenate(
        [((r + s @ theta) / noise).ravel() for r, s in parts]) ** 2)))


def _effect(name, theta, deviation, model):
    place, (_, _, parameter, unit) = SLICES[name], EFFECTS[name]
    value, spread = theta[place], deviation[place]
    entry = {'names': [name], 'evidence': {}}
    if name in INDEXED:
        k = int(np.argmax(np.abs(value)))
        entry[INDEXED[name]] = k + 1
        value, spread = value[k:k + 1], spread[k:k + 1]
    away = {'mass': model.mass, 'inertia': model.inertia, 'thrust_coefficient': 1.0,
            'rotor_thrust_coefficient': 1.0, 'torque_coefficient': model.ratio,
            'rotor_lag': model.lag}.get(name, 0.0)
    if name == 'joint_bandwidth':
        _, kp, kd = model.joint
        entry['parameters'] = {
            key: _number(nominal * (1 + value[k]), nominal * spread[k], unit)
            for k, (key, nominal, unit) in enumerate((('kp', kp, 'N m/rad'),
                                                      ('kd', kd, 'N m s/rad')))}
        return entry
    value = away + value
    if len(value) == 1:
        entry['parameters'] = {parameter: _number(value[0], spread[0], unit)}
    else:
        entry['parameters'] = {parameter: {
            'value': value.tolist(), 'unit': unit,
            'interval': [[v - 1.96 * s, v + 1.96 * s] for v, s in zip(value, spread)]}}
    return entry


def _number(value, spread, unit):
    return {'value': float(value), 'unit': unit,
            'interval': [float(value - 1.96 * spread), float(value + 1.96 * spread)]}


def _write(path, verdict, effects, gaps, reason=None):
    before, after, floor = gaps or (None, None, None)
    closure = None
    if gaps and before ** 2 > floor ** 2:
        closure = 1 - max(after ** 2 - floor ** 2, 0.0) / (before ** 2 - floor ** 2)
    Path(path).write_text(json.dumps({
        'verdict': verdict, 'effects': effects, 'where': [], 'gap_before': before,
        'gap_after': after, 'noise_floor': floor, 'closure': closure, 'candidates': [],
        'next_experiment': None, 'reason': reason}, indent=1))
