"""Verdict about flights of bags and of tables: channels, priors, entries, and the engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from beetle_omni_ros.identify.flights.bag_flight import BagFlight
from beetle_omni_ros.identify.flights.balance import Balance, SLOW
from beetle_omni_ros.identify.flights.body import BodyModel, tilting_modules
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.keys import (
    all_keys,
    entries_of,
    Entry,
    extra_keys,
    Key,
    keys_of,
    LIMITS,
    MODULES,
    OF_ONE,
    of_start,
    Prior,
    prior_of,
    SWING,
    THRUST_BUS,
    TILT_BUS,
    tolerances,
    VARYING,
    VERTICAL,
)
from beetle_omni_ros.identify.flights.results import (
    ALPHA,
    concluded,
    result_of,
    Starts,
    Then,
    Weighed,
)
from beetle_omni_ros.identify.flights.servo import starts_of
from beetle_omni_ros.identify.flights.signals import IMU_LAG
from beetle_omni_ros.identify.flights.table_flight import (
    by_mocap,
    COMPARED,
    DELAYS,
    GROUPS,
    TableFlight,
)
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.recording.bag import Recording
from beetle_omni_ros.identify.recording.conventions import read_tables
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

LATE = 0.0, 0.012, 0.024     # [s] latencies of commands, as apart as a linear delay is accurate
BAG_GROUPS = {group: {'used': True, 'channels': [c for c in BagFlight.channels
                                                 if c.startswith(group)]}
              for group in ('force', 'torque', 'acceleration', 'rate', 'joint')}
HUB = 'rotor_hub_moment'
TORQUES = ('inertia', 'centre_of_mass', 'rotor_thrust_coefficient', 'torque_coefficient', HUB,
           'propeller_gyroscopic_torque', 'rotor_acceleration_torque')
LAGS = ('rotor_lag', 'rotor_dead_time', 'command_latency')
IMU = 'imu_accelerometer_bias', 'imu_misalignment', 'imu_lever_arm'
# Entries of tables that are not of torques.
OTHERS = ('mass', 'thrust_coefficient', 'ground_effect', 'rotor_drag', 'body_drag',
          'axial_inflow', 'translational_lift', 'wind', 'wind_velocity', 'voltage_sag',
          'formula', *LAGS, *IMU, 'imu_gyroscope_bias', 'mocap_misalignment')
JOINTED = 'module_reaction', 'tilt_thrust_loss'     # which fixed tilts do not show
# What shows entries of tables: begins of names of signals and channels, one of which is there.
SHOWN_BY = (
    (('torque_',), TORQUES), (('voltage',), ('voltage_sag',)),
    (('acceleration_', 'rate_'), ('imu_gyroscope_bias', 'mocap_misalignment')),
    (('angular_velocity',), ('imu_lever_arm',)), (('position',), ('ground_effect',)),
    (('position', 'velocity'), ('rotor_drag', 'body_drag', 'axial_inflow', 'translational_lift',
                                HUB)),
    (('force_x',), ('imu_misalignment', 'wind', 'wind_velocity', 'rotor_drag', 'body_drag')))
FEEDBACK = ('the commands explain too little of the angular acceleration: a controller that feeds '
            'back what the model lacks would be taken for the robot')
BALANCED = 'they show the hub moment alone, which the commands balance'
WEIGHED = 'mass', 'inertia'


def judged(flights: Sequence[Recording], judging: Sequence[Recording], robot: RobotParameters,
           p: GapParameters, alpha: float = ALPHA, then: Then | None = None) -> dict:
    """Results of checked flights of bags; ``judging`` is held out. ``then`` may add to them."""
    keys = {**all_keys(robot), **extra_keys(robot)}
    body = BodyModel(robot, keys, tilting_modules(robot))
    every = [BagFlight(flight, robot, body, keys, p) for flight in [*flights, *judging]]
    models, others = every[:len(flights)], every[len(flights):]
    late = first_point(models, every, robot)
    starts = {name: own for name, own in starts_in(keys, models).items()
              if of_start(name)[0] not in p.without}
    tangents = {f'{name}~{key}': (name, key) for name, start in starts.items() for key in start}
    for model in every:
        model.starts, model.tangents = starts, tangents
    coarse = float(np.median([m.signals.position_noise for m in models])) > p.coarse_noise
    delays, kept = _delays(robot, p, coarse)
    tolerance = tolerances(p) | delays
    priors, entries, bounds, far = _priors(robot, {
        n: key for n, key in keys.items() if key.effect in CATALOGUE and not key.form
        and key.effect not in {*LIMITS, *p.without}}, tolerance)
    if robot.multibody is None:     # modules that the file does not have also load the servos
        entries = [replace(entry, keys=(*entry.keys, SWING)) if entry.name == MODULES else entry
                   for entry in entries]
    priors |= {n: Prior(tolerance[n], key.typical, 0.0) for n, key in keys.items()
               if n in tolerance and n not in priors and key.effect not in p.without
               and (n != 'modules.share' or robot.multibody is not None)}
    entries += [Entry(name, tuple(f'servo.{key}[{k}]' for key in TREATMENTS[name].sizes), k + 1,
                      False) for name in sorted({*OF_ONE.values()} - {*LIMITS, *p.without})
                for k in range(4)]
    for start, own in starts.items():
        (name, member), moved = of_start(start), [f'{start}~{key}' for key in own]
        priors[start] = Prior(0.001 if member else 0.03, 1.0, 0.0)
        priors |= {tangent: Prior(0.001, 0.3, 0.0) for tangent in moved}
        entries.append(Entry(name, (start, *moved), member, TREATMENTS[name].channels == 'B'))
    bounds |= dict.fromkeys(starts, (0.0, np.inf)) | kept
    varying = {n: VARYING[n.partition('[')[0]] for n in priors if n.partition('[')[0] in VARYING}
    if len(models) > 1:
        priors |= {n: replace(priors[n], flight=0.0) for n in varying}
    # with noisy encoders, servos act on the body, whose noise a controller answers
    noisy = any(model.noisy for model in models)
    entries = [replace(entry, in_loop=entry.in_loop or noisy) for entry in entries]
    engine = Engine(models, priors, entries, bounds, far, alpha, varying=varying,
                    kept=frozenset(kept), clock=IMU_LAG, curved=frozenset({*starts, *tangents}))
    solution = engine.run({'joint_command_latency.delay': late})
    for model in others:
        model.settle(dict(zip(engine.names, engine.point_of(solution, solution.theta)[
            :engine.real], strict=False)))
    return concluded(Weighed(engine, solution, keys, starts), others or models, BAG_GROUPS,
                     held_out=bool(judging), then=then)


def _priors(robot, keys, tolerance, stamps=0.0):
    """
    Spreads, entries, bounds of keys of the catalogue, and those that may be far from the file.

    A mass is weighed and sensors have data sheets; maps of thrust differ by half.
    """
    priors = {n: prior_of(robot, key, tolerance.get(n, 0.0), stamps) for n, key in keys.items()}
    bounds = {n: (0.0, np.inf) for n, key in keys.items() if key.ends_at_none}
    far = frozenset(n for n, key in keys.items() if key.effect not in WEIGHED
                    and CATALOGUE[key.effect].layer not in ('sensor', 'timing'))
    return priors, entries_of(keys), bounds, far


def first_point(models, every, robot):
    """
    Latency of tilt commands [s] at which the flights are linearised first; choose the modules.

    The file's tilting modules are used if servos and forces agree better with them, at any
    latency. From no latency, a linear fit takes a large one for servos with less stiffness.
    """
    costs, points = {}, [{'command_latency.delay': late} for late in LATE]
    for share in (0.0, 1.0) if robot.multibody is not None else (0.0,):
        for model in models:
            model.modules = share
            model.settle({})
            model.run_servos(points)
        for late, point in zip(LATE, points, strict=True):
            costs[share, late] = sum(float(np.log(r.var(axis=0)).sum()) for model in models
                                     for r in model.residual(point, 'BJ').values())
    share, late = min(costs, key=lambda point: costs[point])
    for model in every:
        model.modules = share
    return late


def starts_in(keys: dict[str, Key], models: Sequence[BagFlight]) -> Starts:
    """Name of a start -> deviations of the keys of its effect, of all joints or of one."""
    result = {}
    for name in LIMITS:
        own = [key for key in keys.values() if key.effect == name and not key.form]
        single = range(4) if own[0].parameter in OF_ONE else ()
        for k, start in enumerate(starts_of(own[0], models)):
            result[f'{name}@{k}'] = dict(zip([key.name for key in own], start, strict=True))
            result |= {f'{name}[{j + 1}]@{k}': {
                f'servo.{key.parameter}[{j}]': value
                for key, value in zip(own, start, strict=True)} for j in single}
    return result


def _delays(robot, p, coarse):
    """
    Prior deviations of delays and of the apparent inertia of servos, and their limits.

    Beyond a limit, a deviation is a finding. ``coarse`` sensors are also late.
    """
    bus, imu = (p.bus_near, (-p.command_delay, p.bus_late)), \
        p.coarse_imu if coarse else p.imu_averaging
    stamps = 2 * p.tolerance_delay      # a reading of the latest IMU may be as much later
    # A module can swing with the joint: its inertia over the servo's, as a logarithm.
    swing = float(np.log(max(tilting_modules(robot)[0] / robot.joints.inertia, 1.0)))
    delays = {TILT_BUS: bus, THRUST_BUS: bus, IMU_LAG: (imu, (0.0, imu + stamps)), SWING: (
        p.tolerance_swing + swing, (-p.tolerance_swing, swing + p.tolerance_swing))}
    if coarse:
        delays['joint_feedback_delay.delay'] = p.coarse_encoders, (0.0, p.coarse_encoders)
    return [{name: own[k] for name, own in delays.items()} for k in range(2)]


def searched_torques() -> tuple[str, ...]:
    """Entries of tables that torques may show, with those that others have added."""
    known = {*TORQUES, *OTHERS, *JOINTED}
    return *TORQUES, *(name for name, effect in CATALOGUE.items() if name in TREATMENTS
                       and effect.apply and not effect.rate and name not in known
                       and effect.layer in ('body', 'rotor'))


def _engine(flights, robot, p, declared, alpha, torques=None):
    """Engine of flights of tables with the entries that channels and signals can show."""
    there = *flights[0].channels, *declared.signals
    names = {*OTHERS, *(torques or searched_torques())}.difference(*(
        hidden for needed, hidden in SHOWN_BY
        if not any(name.startswith(needed) for name in there)))
    if by_mocap(declared.signals):
        names = names - {*IMU} | {'mocap_misalignment'}
    keys = keys_of(robot, names - set(p.without))
    priors, entries, bounds, far = _priors(robot, keys, tolerances(p), declared.clock_deviation)
    far -= set(VERTICAL)
    if estimated(declared):     # the lag is that of an estimator
        priors |= {name: replace(priors[name], narrow=priors[name].typical)
                    for name, key in keys.items() if key.effect in LAGS}
        entries = [entry for entry in entries if entry.name not in LAGS]
    # no servo is simulated from commands, so that every entry acts where feedback answers noise
    entries = [replace(entry, in_loop=True) for entry in entries]
    clock = next((name for name in DELAYS if name in priors), '')
    return Engine(flights, priors, entries, bounds, far, alpha, clock=clock), keys


def estimated(declared: Format) -> bool:
    """Whether an estimator makes the forces."""
    return 'specific_force' not in declared.signals and 'acceleration' in declared.signals


def load_tables(paths: Sequence[Path], robot: RobotParameters, declared: Format
                ) -> list[TableFlight]:
    """
    Read flights.

    Raises:
        LogError, ParameterError: unusable file or format.

    """
    if not {'duty', 'thrust'} & set(declared.signals):
        raise ParameterError(f"--format {declared.name}: expected the key 'duty' or 'thrust'")
    keys = keys_of(robot, {*OTHERS, *searched_torques()})
    body = BodyModel(robot, {**all_keys(robot), **extra_keys(robot)}, tilting_modules(robot))
    return [TableFlight(table, robot, body, keys) for table in read_tables(paths, declared)]


def judged_tables(flights: Sequence[TableFlight], judging: Sequence[TableFlight],
                  robot: RobotParameters, p: GapParameters, declared: Format,
                  alpha: float = ALPHA, then: Then | None = None) -> dict:
    """
    Results of flights of one format; ``judging`` is held out. ``then`` may add to them.

    Raises:
        ParameterError: a flight has other channels than the first one.

    """
    usable = [flight for flight in flights if flight.usable]
    if all(flight.apart for flight in usable):
        for flight in [*flights, *judging]:
            flight.without(COMPARED, flight.apart)
    groups = _groups(flights[0] if not usable else usable[0], declared)
    if not usable:
        return result_of('bad_data', groups, f'No flight can be used: {flights[0].name} has no '
                         f'block of commands and measurements in the air: {flights[0].ranges()}')
    for flight in [*usable, *judging]:
        if flight.usable and flight.channels != usable[0].channels:
            raise ParameterError(f'{flight.name}: its channels are '
                                 f"{', '.join(flight.channels)}, expected those of "
                                 f"{usable[0].name}: {', '.join(usable[0].channels)}")
    findings = [f'{flight.name}: not used, no block of commands and measurements in the air: '
                + flight.ranges() for flight in [*flights, *judging] if not flight.usable] + [
        f'{flight.name}: {flight.apart}, so they are not compared'
        for flight in [*flights, *judging] if flight.apart]
    engine, keys = _engine(usable, robot, p, declared, alpha)
    solution = engine.run()
    if 'torque' in engine.without_motion(engine.balanced):
        # rotors scatter, so that means of torques show nothing
        if 'torque' in engine.without_motion():
            for flight in [*usable, *judging]:
                flight.without(('torque',), FEEDBACK)
            groups = _groups(usable[0], declared)
        else:
            groups['torque']['reason'] = BALANCED
        engine, keys = _engine(usable, robot, p, declared, alpha, (HUB,))
        solution = engine.run()
    judges = [flight for flight in judging if flight.usable] or usable
    slow = [part for f in usable if (part := f.balance(list(keys_of(robot, SLOW))))]
    if slow:
        groups['torque'] = {'used': True, 'channels': ['torque_x', 'torque_y'],
                            'reason': 'no gyroscope: means of 2 s, by the attitude'}
    return concluded(Weighed(engine, solution, keys), judges, groups, bool(judging), findings,
                     Balance(slow, robot) if slow else None, not estimated(declared), then)


def _groups(flight, declared):
    """Each group of channels: whether it is used, and why not."""
    reasons, groups = flight.reasons | {'joint': 'not compared for tables' if (
        'tilt' in declared.signals) else 'the rotors do not tilt'}, {}
    for group in (*GROUPS, 'joint'):
        own = {c: why for c, why in reasons.items() if c.startswith(group)}
        used, unused = [c for c, why in own.items() if not why], sorted({*own.values()} - {''})
        groups[group] = {'used': bool(used), 'channels': used} | (
            {'reason': '; '.join(unused)} if unused else {})
    return groups
