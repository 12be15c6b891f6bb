"""Verdict about flights that were recorded as bags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beetle_omni_ros.identify.flights.bag import BagFlight
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.priors import entries_of, Entry, Spread, spread, VARYING
from beetle_omni_ros.identify.flights.results import ALPHA, concluded
from beetle_omni_ros.identify.gap.body import BodyModel, swing_of, tilting_modules
from beetle_omni_ros.identify.gap.keys import (
    all_keys,
    extra_keys,
    LIMITS,
    THRUST_BUS,
    TILT_BUS,
    tolerances,
)
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import starts_of
from beetle_omni_ros.identify.gap.signals import IMU_LAG
from beetle_omni_ros.identify.gap.treatment import TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

LATE = 0.012, 0.024          # [s] latencies at which the tilting modules are decided, too
COMPARED = {group: {'used': True, 'channels': [c for c in BagFlight.channels
                                               if c.startswith(group)]}
            for group in ('force', 'torque', 'acceleration', 'rate', 'joint')}


def judged(flights: Sequence, judging: Sequence, robot: RobotParameters, p: GapParameters,
           alpha: float = ALPHA) -> dict:
    """Results of checked flights; ``judging`` is held out."""
    keys = {**all_keys(robot), **extra_keys()}
    body = BodyModel(robot, keys, tilting_modules(robot))
    every = [BagFlight(flight, robot, body, keys, p) for flight in [*flights, *judging]]
    models, others = every[:len(flights)], every[len(flights):]
    if robot.multibody is not None:
        _choose_modules(models, every)
    starts = _starts(keys, models)
    tangents = {f'{name}~{key}': (name, key) for name, start in starts.items() for key in start}
    for model in every:
        model.starts, model.tangents = starts, tangents
    coarse = float(np.median([m.signals.position_noise for m in models])) > p.coarse_noise
    names, spreads, entries = _priors(robot, keys, p, starts, coarse)
    kept = _limits(robot, p, coarse)
    bounds = {n: (0.0, np.inf) for n in names
              if n in starts or n in keys and keys[n].ends_at_none} | kept
    far = frozenset(n for n in names if n in keys and keys[n].effect in CATALOGUE
                    and keys[n].effect not in ('mass', 'inertia')
                    and CATALOGUE[keys[n].effect].layer not in ('sensor', 'timing'))
    varying = {n: VARYING[n.partition('[')[0]] for n in names if n.partition('[')[0] in VARYING}
    if len(models) > 1:
        spreads |= {n: replace(spreads[n], flight=0.0) for n in varying}
    engine = Engine(models, names, spreads, entries, bounds, far, alpha, varying=varying,
                    kept=frozenset(kept), clock=IMU_LAG, curved=frozenset({*starts, *tangents}))
    solution = engine.run()
    for model in others:
        model.settle(dict(zip(names, solution.theta, strict=False)))
    return concluded(engine, solution, keys, others or models, COMPARED, starts=starts,
                     held_out=bool(judging))


def _choose_modules(models, every):
    """Use the file's tilting modules if the servos agree better with them, at any latency."""
    costs = []
    for share in (0.0, 1.0):
        for model in models:
            model.modules = share
            model.settle({})
        costs.append(min(sum(float(np.log(r.var(axis=0)).sum()) for model in models
                             for r in model.residual(late, 'BJ').values())
                         for late in ({}, *({'command_latency.delay': d} for d in LATE))))
    for model in every:
        model.modules = float(np.argmin(costs))


def _starts(keys, models):
    """Name of a start -> deviations of the keys of its effect."""
    result = {}
    for name in LIMITS:
        own = [key for key in keys.values() if key.effect == name and not key.form]
        for k, start in enumerate(starts_of(own[0], models)):
            result[f'{name}@{k}'] = dict(zip([key.name for key in own], start, strict=True))
    return result


def _limits(robot, p, coarse):
    """Limits of tolerances, beyond which a deviation is a finding."""
    bus = -p.command_delay, p.bus_late
    limits = {TILT_BUS: bus, THRUST_BUS: bus,
              'imu_filter_lag.delay': (0.0, p.coarse_imu if coarse else p.imu_averaging),
              'swing.ratio': (-p.tolerance_swing, swing_of(robot) + p.tolerance_swing)}
    return limits | ({'joint_feedback_delay.delay': (0.0, p.coarse_encoders)} if coarse else {})


def _priors(robot, keys, p, starts, coarse):
    """Names of the keys, their spreads, and the entries; ``coarse`` sensors are also late."""
    fitted = {n: key for n, key in keys.items() if not key.form and key.effect not in LIMITS
              and (n != 'modules.share' or robot.multibody is not None)}
    tolerance = tolerances(p) | {
        TILT_BUS: p.bus_near, THRUST_BUS: p.bus_near,
        'imu_filter_lag.delay': p.coarse_imu if coarse else p.imu_averaging,
        'joint_feedback_delay.delay': p.coarse_encoders if coarse else p.tolerance_delay,
        'swing.ratio': p.tolerance_swing + swing_of(robot)}
    spreads = {n: spread(robot, key, tolerance.get(n, 0.0), 0.0)
               if key.effect in CATALOGUE else Spread(tolerance[n], key.typical, 0.0)
               for n, key in fitted.items()}
    entries = entries_of({n: key for n, key in fitted.items() if key.effect in CATALOGUE})
    for start, own in starts.items():
        tangents = [f'{start}~{key}' for key in own]
        spreads[start] = Spread(0.03, 1.0, 0.0)
        spreads |= {name: Spread(0.001, 0.3, 0.0) for name in tangents}
        name = start.partition('@')[0]
        entries.append(Entry(name, (start, *tangents), None, TREATMENTS[name].channels == 'B'))
    return [*spreads], spreads, entries
