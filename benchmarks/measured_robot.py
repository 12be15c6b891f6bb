"""
False alarms and reached poses on the measured robot, its drawn variants, and unmet robots.

    python benchmarks/measured_robot.py [--controllers nmpc,rl] [--hours 1] [--draws 20]
                                        [--unmet 0] [--seed 0] [--robot FILE] [--plant measured]
                                        [--policy FILE] [--jobs 2] [--json FILE]

Each controller flies `--hours` in each condition to random poses of 8 s, in flights of 15 poses.
It also flies ten poses with each of `--draws` robots, drawn from the intervals of the robot file,
and with each of `--unmet` robots (:func:`unmet`). No fault is injected, so each reported fault,
fallback or landing is a false alarm. The bound is the 95 % limit of their rate. The flight stack
has the shipped robot file, or `--robot`; of `--unmet` the robot's own. `--policy`: another file.
"""

import argparse
from dataclasses import replace
from math import ceil
from pathlib import Path
import sys

import joblib
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chi2

from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.campaign import workers
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.degraded import sphere
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import mass_properties, RobotParameters
from beetle_omni_ros.model.schema import ParameterError

POSES, POSE_TIME, OF_DRAWN = 15, 8.0, 10    # of a flight; [s]; poses of a drawn robot
DRAWN, UNMET = 'drawn', 'unmet'
DIRECTIONS, FULL_THRUST = 200, 0.85     # of up, at which a robot must hover with a half empty pack


def unmet(rng: np.random.Generator) -> RobotParameters:
    """
    Draw a robot that differs from the shipped one.

    Mass, inertia and arms by +-30 %, thrust and lags by +-25 %; a third each have one rotor that
    loses up to 30 % and a payload of up to 1 kg, 8 cm below the centre. An impossible robot is
    drawn again, also one that cannot hover at every attitude with a half empty pack.
    """
    shipped = RobotParameters.load()
    rotors, joints = shipped.rotors, shipped.joints
    while True:
        mass, arm = shipped.mass * rng.uniform(0.7, 1.3), rng.uniform(0.7, 1.3)
        load = rng.uniform(0.0, 1.0) * (rng.random() < 1 / 3)
        gain = np.full(4, rng.uniform(0.75, 1.25))
        gain[rng.integers(4)] *= 1 - rng.uniform(0.0, 0.3) * (rng.random() < 1 / 3)
        robot = replace(
            shipped, intervals={},
            rotors=replace(rotors, positions=arm * rotors.positions,
                           time_constant=rotors.time_constant * rng.uniform(0.75, 1.25)),
            joints=replace(joints, kd=joints.kd * rng.uniform(0.75, 1.25)),
            effects={'mass': {'mass': mass + load},
                     'inertia': {'inertia': tuple(shipped.inertia * rng.uniform(0.7, 1.3, 3))},
                     'rotor_thrust_coefficient': {'scale': tuple(gain)},
                     'centre_of_mass': {'offset': (0.0, 0.0, -0.08 * load / (mass + load))}})
        _, thrusts = Allocator(robot).upright(sphere(DIRECTIONS))
        try:
            mass_properties(robot)
        except ParameterError:
            continue
        if thrusts.max() <= FULL_THRUST * rotors.thrust_max:
            return robot


def fly_one(controller: str, kind: str, seed: int, robot: str | None, plant: str,
            policy: Path | None) -> dict:
    """Fly in a condition, or with a drawn robot; returns counts, the errors and the alarms."""
    known, true = RobotParameters.load(robot), RobotParameters.load(plant)
    if kind == DRAWN:
        true = true.drawn(np.random.default_rng(seed))
    elif kind == UNMET:
        known = true = unmet(np.random.default_rng(seed))
    other = kind in (DRAWN, UNMET)
    task = make_task(f'random{OF_DRAWN if other else POSES}', seed)
    log = fly(controller, task, robot=known, plant=true, seed=seed,
              conditions='nominal' if other else kind,
              options={controller: ControllerOptions(policy=policy)})
    result = metrics(log, task)
    poses, ended = result['poses'], result.get('ended', '')
    alarms = [*log.named_faults(), ended, result.get('controller_error', '')]
    return {'controller': controller, 'kind': kind, 'seed': seed, 'hours': POSE_TIME * sum(
                pose['U_position_m'] is not None for pose in poses) / 3600,
            'poses': len(poses), 'reached': sum(pose['reached'] for pose in poses),
            'U_position_m': [pose['U_position_m'] for pose in poses],
            'U_orientation_deg': [pose['U_orientation_deg'] for pose in poses],
            'tilt_change_rad': [result['hover_command_change_rms']['joint_rad']],
            'alarms': [alarm for alarm in alarms if alarm]}


def summary(flights: list[dict]) -> list[dict]:
    """Sums of the flights with the same controller and kind."""
    rows = []
    for controller, kind in dict.fromkeys((one['controller'], one['kind']) for one in flights):
        flown = [one for one in flights if (one['controller'], one['kind']) == (controller, kind)]
        hours, alarmed = sum(one['hours'] for one in flown), sum(
            bool(one['alarms']) for one in flown)
        errors = {key: [value for one in flown for value in one[key] if value is not None]
                  for key in ('U_position_m', 'U_orientation_deg', 'tilt_change_rad')}
        rows.append({
            'controller': controller, 'kind': kind, 'flights': len(flown), 'hours': hours,
            'poses': sum(one['poses'] for one in flown),
            'reached': sum(one['reached'] for one in flown), 'flights_with_alarm': alarmed,
            'bound_per_hour': chi2.ppf(0.95, 2 * alarmed + 2) / 2 / hours if hours else None,
            **{f'{name}_{key}': float(function(values)) if values else None
               for key, values in errors.items()
               for name, function in (('mean', np.mean), ('max', np.max))},
            'alarms': [f"seed {one['seed']}: {', '.join(one['alarms'])}" for one in flown
                       if one['alarms']]})
    return rows


def main() -> None:
    """Fly and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--controllers', default='nmpc,rl')
    parser.add_argument('--hours', type=float, default=1.0)
    parser.add_argument('--draws', type=int, default=20)
    parser.add_argument('--unmet', type=int, default=0)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--robot')
    parser.add_argument('--plant', default='measured')
    parser.add_argument('--policy', type=Path)
    parser.add_argument('--jobs', type=int, default=2)
    parser.add_argument('--json', type=Path)
    chosen = parser.parse_args()
    number = ceil(3600 * chosen.hours / (POSES * POSE_TIME))
    trials = [(controller, kind, chosen.seed + k)
              for controller in chosen.controllers.split(',')
              for kind, count in (('nominal', number), ('published', number),
                                  (DRAWN, chosen.draws), (UNMET, chosen.unmet))
              for k in range(count)]
    console = Console(width=None if sys.stdout.isatty() else 140)
    with workers(jobs=chosen.jobs):
        flights = list(track(joblib.Parallel(return_as='generator', batch_size=1)(
            joblib.delayed(fly_one)(*trial, chosen.robot, chosen.plant, chosen.policy)
            for trial in trials), 'flights', total=len(trials), console=console))
    rows = summary(flights)
    table = Table('controller', 'robot', 'hours', 'reached', 'U mean (max)',
                  r'tilt change \[rad/10 ms]', 'flights with an alarm', 'bound [1/h]')
    for row in rows:
        table.add_row(
            row['controller'], row['kind'], f"{row['hours']:.2f}",
            f"{row['reached']} of {row['poses']}",
            '–' if row['mean_U_position_m'] is None else
            f"{row['mean_U_position_m']:.4f} ({row['max_U_position_m']:.4f}) m, "
            f"{row['mean_U_orientation_deg']:.2f} ({row['max_U_orientation_deg']:.2f}) deg",
            '–' if row['mean_tilt_change_rad'] is None else f"{row['mean_tilt_change_rad']:.4f}",
            f"{row['flights_with_alarm']} of {row['flights']}",
            '–' if row['bound_per_hour'] is None else f"{row['bound_per_hour']:.1f}")
    console.print(table)
    for row in rows:
        for alarm in row['alarms']:
            console.print(f"{row['controller']}, {row['kind']}, {alarm}", markup=False)
    write_json(chosen.json, {'meta': {key: str(value) for key, value in vars(chosen).items()},
                             'summary': rows, 'flights': flights})


if __name__ == '__main__':
    try:
        main()
    except ParameterError as error:
        sys.exit(f'measured_robot.py: {error}')
