"""Verdict about flights that were read from tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from beetle_omni_ros.identify.flights.balance import Balance, SLOW
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.priors import entries_of, keys_of, spread
from beetle_omni_ros.identify.flights.quality import explained
from beetle_omni_ros.identify.flights.residual import COMPARED, GROUPS, TableFlight
from beetle_omni_ros.identify.flights.results import ALPHA, concluded, result_of
from beetle_omni_ros.identify.flights.table import Format, read_flight
from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.keys import all_keys, extra_keys, tolerances
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

# Entries of each group of channels. Those of the torques also need the forces.
FORCES = ('mass', 'thrust_coefficient', 'ground_effect', 'rotor_drag', 'body_drag',
          'axial_inflow', 'translational_lift', 'wind', 'voltage_sag', 'rotor_lag',
          'rotor_dead_time', 'command_latency', 'imu_accelerometer_bias', 'imu_misalignment')
TORQUES = ('inertia', 'centre_of_mass', 'rotor_thrust_coefficient', 'torque_coefficient',
           'rotor_hub_moment', 'propeller_gyroscopic_torque', 'rotor_acceleration_torque')
EXPLAINED = 0.5         # share of the angular acceleration: below, errors exceed what is explained
FEEDBACK = ('the commands explain less than half of the angular acceleration: a controller that '
            'feeds back what the model lacks would be taken for the robot')
LAGS = ('rotor_lag', 'rotor_dead_time', 'command_latency')
# Entries of the comparison of IMU and MoCap.
SENSORS = ('imu_gyroscope_bias', 'mocap_misalignment')


def _engine(flights, robot, p, declared, alpha, progress):
    """Engine of the flights with the entries that their channels and signals can show."""
    torque = any(name.startswith('torque') for name in flights[0].channels)
    names = set(FORCES) | set(TORQUES if torque else ())
    if any(name.startswith(COMPARED) for name in flights[0].channels):
        names |= set(SENSORS)
    if 'position' not in declared.signals:
        names -= {'ground_effect'}
    if not {'position', 'velocity'} & set(declared.signals):
        names -= {'rotor_drag', 'body_drag', 'axial_inflow', 'translational_lift',
                  'rotor_hub_moment'}
    if 'voltage' not in declared.signals:
        names -= {'voltage_sag'}
    if 'force_x' not in flights[0].channels:
        names -= {'imu_misalignment', 'wind', 'rotor_drag', 'body_drag'}
    keys = keys_of(robot, names)
    tolerance = tolerances(p)
    spreads = {name: spread(robot, key, tolerance.get(name, 0.0), declared.clock_deviation)
               for name, key in keys.items()}
    free = LAGS if 'specific_force' not in declared.signals else ()  # the lag of an estimator
    spreads |= {name: replace(spreads[name], narrow=spreads[name].typical)
                for name, key in keys.items() if key.effect in free}
    entries = [entry for entry in entries_of(keys) if entry.name not in free]
    bounds = {name: (0.0, np.inf) for name, key in keys.items() if key.ends_at_none}
    # A mass is weighed, air is still and sensors have data sheets; maps of thrust differ by half.
    far = frozenset(name for name, key in keys.items() if key.effect not in (
        'mass', 'inertia', 'wind') and CATALOGUE[key.effect].layer not in ('sensor', 'timing'))
    return Engine(flights, list(keys), spreads, entries, bounds, far, alpha, progress), keys


def load_tables(paths: Sequence[Path], robot: RobotParameters, declared: Format
                ) -> list[TableFlight]:
    """
    Read flights.

    Raises:
        LogError, ParameterError: unusable file or format.

    """
    if not {'duty', 'thrust'} & set(declared.signals):
        raise ParameterError(f"--format {declared.name}: expected the key 'duty' or 'thrust'")
    keys = keys_of(robot, {*FORCES, *TORQUES, *SENSORS})
    body = BodyModel(robot, {**all_keys(robot), **extra_keys()}, (0.0, 0.0))
    return [TableFlight(read_flight(path, declared), robot, body, keys) for path in paths]


def judged_tables(flights: Sequence[TableFlight], judging: Sequence[TableFlight],
                  robot: RobotParameters, p: GapParameters, declared: Format,
                  alpha: float = ALPHA, progress: Callable[[str], None] = lambda text: None
                  ) -> dict:
    """
    Results of flights of one format; ``judging`` is held out.

    Raises:
        ParameterError: a flight has other channels than the first one.

    """
    usable = [flight for flight in flights if flight.usable]
    if all(flight.apart for flight in usable):
        for flight in [*flights, *judging]:
            flight.without(COMPARED, flight.apart)
    groups = _groups(flights[0] if not usable else usable[0], declared)
    if not usable:
        return result_of('bad_data', groups, 'No flight can be used: '
                         f'{flights[0].name} has no block of commands and measurements in the air')
    for flight in [*usable, *judging]:
        if flight.usable and flight.channels != usable[0].channels:
            raise ParameterError(f'{flight.name}: its channels are '
                                 f"{', '.join(flight.channels)}, expected those of "
                                 f"{usable[0].name}: {', '.join(usable[0].channels)}")
    findings = [f'{flight.name}: not used, no block of commands and measurements in the air'
                for flight in [*flights, *judging] if not flight.usable] + [
        f'{flight.name}: {flight.apart}, so they are not compared'
        for flight in [*flights, *judging] if flight.apart]
    engine, keys = _engine(usable, robot, p, declared, alpha, progress)
    solution = engine.run()
    if groups['torque']['used'] and explained(engine, solution, 'torque') < EXPLAINED:
        for flight in [*usable, *judging]:
            flight.without(('torque',), FEEDBACK)
        groups = _groups(usable[0], declared)
        engine, keys = _engine(usable, robot, p, declared, alpha, progress)
        solution = engine.run()
    progress('judging')
    judges = [flight for flight in judging if flight.usable] or usable
    slow = [part for f in usable if (part := f.balance(list(keys_of(robot, SLOW))))]
    if slow:
        groups['torque'] = {'used': True, 'channels': ['torque_x', 'torque_y'],
                            'reason': 'no gyroscope: means of 2 s, by the attitude'}
    return concluded(engine, solution, keys, judges, groups, held_out=bool(judging),
                     findings=findings, slow=Balance(slow, robot) if slow else None,
                     measured='specific_force' in declared.signals)


def _groups(flight, declared):
    """Each group of channels: whether it is used, and why not."""
    groups = {}
    for group in GROUPS:
        own = {c: why for c, why in flight.reasons.items() if c.startswith(group)}
        used = [c for c, why in own.items() if not why]
        unused = sorted({why for why in own.values() if why})
        groups[group] = {'used': bool(used), 'channels': used,
                         **({'reason': '; '.join(unused)} if unused else {})}
    signals = declared.signals
    groups['joint'] = {'used': False, 'channels': [],
                       'reason': 'not compared for tables' if 'tilt' in signals
                       else 'the rotors do not tilt'}
    return groups
